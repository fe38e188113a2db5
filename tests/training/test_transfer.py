"""Batches on their way to a device: what is copied where, and when it may be used."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from small_policy import batch as batch_of

from imfvla.data import Augmentation
from imfvla.training.parallel import Alone, Shared
from imfvla.training.transfer import Sent, Transfer

CPU = torch.device("cpu")


class WrittenDown:
    """Streams of a device that is not there: says what was asked of them, in order."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.aside_now = False

    @contextmanager
    def aside(self):
        self.said.append("aside")
        self.aside_now = True
        yield
        self.aside_now = False

    def pin(self, tensor):
        assert not self.aside_now
        self.said.append("pin")
        return tensor.clone()

    def mark(self):
        self.said.append("mark")
        return len(self.said)

    def wait(self, event):
        self.said.append(f"wait {event}")

    def keep(self, tensor):
        assert isinstance(tensor, torch.Tensor)
        self.said.append("keep")


def tensors(batch) -> list[torch.Tensor]:
    return [batch.obs.images, batch.obs.state, batch.obs.instruction, batch.actions, batch.valid]


@pytest.mark.parametrize("streams", [None, WrittenDown()])
@pytest.mark.parametrize("size", [1, 2])
def test_a_process_gets_its_rows_with_their_changes(streams, size):
    batch, augmentation = batch_of(4), Augmentation(shift_px=3)
    changes = augmentation.draw(batch.obs.images, np.random.default_rng(0))
    expected = augmentation(batch.obs.images, np.random.default_rng(0))
    for rank in range(size):
        transfer = Transfer(Alone() if size == 1 else Shared(rank, size, size), CPU, streams)
        sent = transfer.send(batch, changes)
        mine = slice(rank * 4 // size, (rank + 1) * 4 // size)
        received = transfer.receive(sent)
        assert torch.equal(received.obs.images, expected[mine])
        for own, whole in zip(tensors(received)[1:], tensors(batch)[1:], strict=True):
            assert torch.equal(own, whole[mine])


def test_a_copy_is_made_aside_from_pinned_memory_and_waited_for_by_the_stream():
    streams, batch = WrittenDown(), batch_of(4)
    transfer = Transfer(Alone(), CPU, streams)
    sent = transfer.send(batch)
    assert streams.said == ["pin"] * 5 + ["aside", "mark"]
    assert isinstance(sent, Sent)
    streams.said.clear()
    transfer.receive(sent)
    assert streams.said == ["wait 7"] + ["keep"] * 5


def test_without_streams_a_batch_is_handed_on_as_it_is():
    batch = batch_of(4)
    for own, whole in zip(tensors(Transfer(Alone(), CPU).receive(batch)), tensors(batch), strict=True):
        assert own is whole
