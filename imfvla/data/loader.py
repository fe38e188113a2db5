"""Batches prepared in the background while the previous one trains."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from imfvla.data.augment import Augmentation, Changes, changed
from imfvla.data.same_content import refuse_other_content
from imfvla.data.sampler import ResumableSampler
from imfvla.data.windows import Windows
from imfvla.types import Batch

DATA = "data"  # key of a state
RANDOM_STREAM = 1  # differs from the sampler's SeedSequence([seed, epoch]) in length


class Loader(Iterator[Any]):
    """Endless iterator over the batches of `sampler`, `prefetch` of them prepared ahead by `threads` threads.

    Batch i, with its instructions and augmentation, depends on the sampler's seed and i alone, and batches come in
    order however many threads there are. The state counts batches handed out, not those prepared, so a run that resumes
    sees exactly what it would have seen. `wait_s` adds up the time [s] that the caller waited for data.
    """

    def __init__(
        self,
        windows: Windows,
        sampler: ResumableSampler,
        *,
        augment: Augmentation | None = None,
        prefetch: int = 2,
        threads: int = 1,
    ) -> None:
        if prefetch < 1 or threads < 1:
            raise ValueError(f"prefetch and threads must be at least 1, found {prefetch} and {threads}.")
        self.wait_s = 0.0
        self._windows = windows
        self._sampler = sampler
        self._augment = augment
        self._prefetch = prefetch
        self._finish: Callable[[Batch, Changes | None], Any] | None = None
        self._ahead: deque[Future[Any]] = deque()
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="loader")

    def finish_with(self, finish: Callable[[Batch, Changes | None], Any]) -> None:
        """From now on hands out what `finish` makes of batches and the changes of their pictures, which it must apply.

        It is called in the loader's threads.
        """
        self._drop()
        self._finish = finish

    def __next__(self) -> Any:
        first = self._sampler.next_batch
        while len(self._ahead) <= self._prefetch:
            self._ahead.append(self._threads.submit(self._finished, first + len(self._ahead)))
        began = time.perf_counter()
        batch = self._ahead.popleft().result()
        self.wait_s += time.perf_counter() - began
        self._sampler.next_batch += 1
        return batch

    def batch(self, number: int) -> Batch:
        """Batch `number`, independent of earlier draws."""
        return changed(*self._drawn(number))

    def _drawn(self, number: int) -> tuple[Batch, Changes | None]:
        """Batch `number` as it was recorded, and the changes of its pictures."""
        seeds = np.random.SeedSequence([self._sampler.seed, RANDOM_STREAM, number])
        rng = np.random.default_rng(seeds)
        batch = self._windows.batch(self._sampler.batch(number), rng)
        return batch, None if self._augment is None else self._augment.draw(batch.obs.images, rng)

    def _finished(self, number: int) -> Any:
        return self.batch(number) if self._finish is None else self._finish(*self._drawn(number))

    def describe(self, number: int) -> list[str]:
        """Episode file and step of each row of batch `number`."""
        return self._windows.describe(self._sampler.batch(number))

    def state_dict(self) -> dict[str, Any]:
        """The sampler's state, which is the next batch to hand out, and digests of the data."""
        return {**self._sampler.state_dict(), DATA: dict(self._windows.store.content)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resumes where `state` was taken; batches prepared ahead are dropped.

        Raises UserError where number of items, batch size, seed or data differ.
        """
        self._sampler.load_state_dict(state)
        refuse_other_content(state.get(DATA), self._windows.store, "the saved state")
        self._drop()

    def close(self) -> None:
        """Stops the background threads."""
        self._drop()
        self._threads.shutdown()

    def __enter__(self) -> "Loader":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _drop(self) -> None:
        for future in self._ahead:
            future.cancel()
        self._ahead.clear()
