"""Which items make up which batch: a pure function of the seed and the batch's number."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, TypedDict

import numpy as np

from imfvla.errors import UserError
from imfvla.options import at_least
from imfvla.storage.records import Seed, Step, as_record


class SamplerState(TypedDict):
    """Where in the batches of which data a training is."""

    next_batch: Step
    num_items: Annotated[int, at_least(1)]
    batch_size: Annotated[int, at_least(1)]
    seed: Seed


class ResumableSampler:
    """Endless batches of item indices, each epoch a new permutation of all items.

    Epoch e is permuted by `SeedSequence([seed, e])`; batches continue across the border between epochs, so
    every item is drawn once an epoch, whatever the batch size. The whole state is the number of the next
    batch.
    """

    def __init__(self, num_items: int, batch_size: int, seed: int) -> None:
        if num_items < 1 or batch_size < 1:
            raise ValueError(f"Wanted at least 1 item and batch size 1, found {num_items} and {batch_size}.")
        self.num_items = num_items
        self.batch_size = batch_size
        self.seed = seed
        self.next_batch = 0

    @property
    def epoch(self) -> float:
        """Epochs drawn so far."""
        return self.next_batch * self.batch_size / self.num_items

    def batch(self, number: int) -> np.ndarray:
        """Item indices of batch `number`: int64 (batch_size,)."""
        drawn = np.arange(number * self.batch_size, (number + 1) * self.batch_size)
        epochs, places = np.divmod(drawn, self.num_items)
        indices = np.empty(self.batch_size, np.int64)
        for epoch in np.unique(epochs):
            here = epochs == epoch
            indices[here] = _permutation(self.seed, int(epoch), self.num_items)[places[here]]
        return indices

    def state_dict(self) -> dict[str, int]:
        """What `load_state_dict` needs to resume at the next batch."""
        names = ("next_batch", "num_items", "batch_size", "seed")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Resumes where `state` was taken. Raises UserError where data, batch size or seed differ, or are not said."""
        remedy = "restore the state, or move it away and train again"
        state = as_record(state, SamplerState, "The batches of the state to resume from", remedy)
        for name in ("num_items", "batch_size", "seed"):
            if state[name] != getattr(self, name):
                raise UserError(
                    f"Cannot resume: the checkpoint was made with {name} {state[name]}, found "
                    f"{getattr(self, name)}. Restore the run's data and configuration, or start a new run."
                )
        self.next_batch = state["next_batch"]


@lru_cache(maxsize=2)  # a batch at the border of two epochs needs both
def _permutation(seed: int, epoch: int, num_items: int) -> np.ndarray:
    return np.random.default_rng(np.random.SeedSequence([seed, epoch])).permutation(num_items)
