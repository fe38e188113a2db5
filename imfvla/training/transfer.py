"""From the loader's threads to the policy's device: this process's rows of a batch, copied while another one trains.

On a GPU a loader's thread puts the rows into pinned memory, and a stream of its own copies them, so that neither the
training's thread nor its stream waits for a copy that has been made ahead. Pictures are changed where they arrive.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor

from imfvla.data.augment import Changes, changed
from imfvla.training.parallel import Alone
from imfvla.types import Batch, Observation


class Streams(Protocol):
    """What a device offers to copy aside; `Cuda` does."""

    def aside(self) -> AbstractContextManager[Any]:
        """Inside, this thread's work goes to a stream for copies."""
        ...

    def pin(self, tensor: Tensor) -> Tensor: ...
    def mark(self) -> Any:
        """An event behind what the stream for copies has been given so far."""
        ...

    def wait(self, event: Any) -> None:
        """Lets the training's stream wait for an event; the calling thread goes on."""
        ...

    def keep(self, tensor: Tensor) -> None:
        """Memory that was filled aside is used by the training's stream: it is not given away before that has."""
        ...


class Cuda:
    """A stream of copies beside the current stream of `device`."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._copies = torch.cuda.Stream(device)

    def aside(self) -> AbstractContextManager[Any]:
        return torch.cuda.stream(self._copies)

    def pin(self, tensor: Tensor) -> Tensor:
        return tensor.pin_memory()

    def mark(self) -> torch.cuda.Event:
        return self._copies.record_event()

    def wait(self, event: torch.cuda.Event) -> None:
        torch.cuda.current_stream(self._device).wait_event(event)

    def keep(self, tensor: Tensor) -> None:
        tensor.record_stream(torch.cuda.current_stream(self._device))


@dataclass(frozen=True, slots=True)
class Sent:
    """A batch under way."""

    share: Batch  # this process's rows, on the device as soon as `event` has come
    changes: Changes | None  # of their pictures
    event: Any


class Transfer:
    """Hands out this process's rows of batches on `device`; `streams` are those of a GPU, None for a CPU."""

    def __init__(self, processes: Alone, device: torch.device, streams: Streams | None = None) -> None:
        self._processes, self._device = processes, device
        self._streams = streams or (Cuda(device) if device.type == "cuda" else None)

    def attach(self, batches: Iterator[Any]) -> None:
        """Lets batches begin their way in the threads that prepare them, where that makes a difference."""
        if self._streams is not None and hasattr(batches, "finish_with"):
            batches.finish_with(self.send)

    def send(self, batch: Batch, changes: Changes | None = None) -> Sent:
        """Begins the copy of this process's rows."""
        share = self._processes.share(batch)
        if changes is not None:
            changes = changes.map(self._processes.share_of)
        if self._streams is None:
            return Sent(_map(self._moved, share), changes, None)
        pinned = _map(self._streams.pin, share)
        changes = None if changes is None else changes.map(self._streams.pin)
        with self._streams.aside():
            moved = _map(self._moved, pinned)
            changes = None if changes is None else changes.map(self._moved)
        return Sent(moved, changes, self._streams.mark())

    def receive(self, found: Batch | Sent) -> Batch:
        """The rows, for work that the current stream is given from now on."""
        sent = found if isinstance(found, Sent) else self.send(found)
        if self._streams is not None:
            self._streams.wait(sent.event)
            _map(self._kept, sent.share)
            if sent.changes is not None:
                sent.changes.map(self._kept)
        return changed(sent.share, sent.changes)

    def _moved(self, tensor: Tensor) -> Tensor:
        return tensor.to(self._device, non_blocking=True)

    def _kept(self, tensor: Tensor) -> Tensor:
        self._streams.keep(tensor)
        return tensor


def _map(function: Callable[[Tensor], Tensor], batch: Batch) -> Batch:
    """With every tensor of a batch replaced by what `function` makes of it."""
    seen = Observation(*(function(getattr(batch.obs, field.name)) for field in fields(Observation)))
    return Batch(seen, function(batch.actions), function(batch.valid))
