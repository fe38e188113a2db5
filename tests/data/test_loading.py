"""Which batch comes when, with which augmentation: functions of the seed and the batch's number alone."""

import threading
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from synthetic import VIEWS

from imfvla.config.horizon import Horizon
from imfvla.data import Augmentation, FrameStore, Loader, ResumableSampler, Windows
from imfvla.errors import UserError
from imfvla.sources.mcap import McapSource
from imfvla.tasks.bimanual_robot import bimanual_robot

ROBOT = bimanual_robot(VIEWS, (32, 32))


@pytest.fixture
def windows(synthetic_demonstrations, tmp_path) -> Windows:
    store = FrameStore.build(McapSource.of(synthetic_demonstrations), tmp_path / "store", (32, 32), VIEWS)
    return Windows(store, Horizon(1, 8, 4), ROBOT)


def assert_same(left, right) -> None:
    for name in ("images", "state", "instruction"):
        assert torch.equal(getattr(left.obs, name), getattr(right.obs, name))
    assert torch.equal(left.actions, right.actions)
    assert torch.equal(left.valid, right.valid)


def loader(windows: Windows, **options) -> Loader:
    return Loader(windows, ResumableSampler(len(windows), 10, seed=3), augment=Augmentation(), **options)


@pytest.mark.parametrize(("num_items", "batch_size"), [(36, 10), (36, 36), (7, 20), (1, 3), (100, 1)])
def test_every_item_is_drawn_once_an_epoch(num_items, batch_size):
    sampler = ResumableSampler(num_items, batch_size, seed=0)
    drawn = np.concatenate([sampler.batch(number) for number in range(-(-3 * num_items // batch_size))])
    epochs = drawn[: 3 * num_items].reshape(3, num_items)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(num_items), (3, 1)))
    if num_items > 5:
        assert (epochs[0] != epochs[1]).any()


def test_a_batch_depends_on_seed_and_number_alone():
    sampler = ResumableSampler(36, 10, seed=0)
    later = sampler.batch(17)
    sampler.batch(3)
    np.testing.assert_array_equal(ResumableSampler(36, 10, seed=0).batch(17), later)
    assert (ResumableSampler(36, 10, seed=1).batch(17) != later).any()


def test_a_sampler_resumes_only_its_own_run():
    sampler = ResumableSampler(36, 10, seed=0)
    sampler.next_batch = 9
    assert sampler.epoch == 2.5
    resumed = ResumableSampler(36, 10, seed=0)
    resumed.load_state_dict(sampler.state_dict())
    assert resumed.next_batch == 9
    for other in (ResumableSampler(37, 10, 0), ResumableSampler(36, 11, 0), ResumableSampler(36, 10, 1)):
        with pytest.raises(UserError, match="Cannot resume"):
            other.load_state_dict(sampler.state_dict())


def test_a_resumed_loader_is_equal_bit_for_bit(windows):
    with loader(windows, prefetch=1) as uninterrupted:
        expected = list(islice(uninterrupted, 9))
    with loader(windows, prefetch=4) as first:
        list(islice(first, 5))
        state = first.state_dict()
    assert state["next_batch"] == 5  # handed out, not prepared
    with loader(windows, prefetch=2) as resumed:
        next(resumed)
        resumed.load_state_dict(state)
        for batch, wanted in zip(islice(resumed, 4), expected[5:], strict=True):
            assert_same(batch, wanted)


def test_batches_are_the_windows_that_the_sampler_drew(windows):
    sampler = ResumableSampler(len(windows), 10, seed=3)
    with Loader(windows, sampler) as plain:
        batch = next(plain)
    wanted = windows.batch(sampler.batch(0), np.random.default_rng(0))
    assert torch.equal(batch.obs.images, wanted.obs.images)
    assert torch.equal(batch.actions, wanted.actions)


def test_an_error_in_the_background_reaches_the_caller(windows):
    windows.batch = lambda indices, rng: 1 / 0
    with loader(windows) as broken, pytest.raises(ZeroDivisionError):
        next(broken)


def test_waiting_is_added_up(windows):
    with loader(windows) as waiting:
        assert waiting.wait_s == 0
        next(waiting)
        assert waiting.wait_s > 0


def images(b: int = 5, to: int = 2, v: int = 3) -> torch.Tensor:
    return torch.randint(
        0, 256, (b, to, v, 3, 16, 20), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )


def test_no_augmentation_changes_nothing():
    augment = Augmentation(shift_px=0, brightness=0, contrast=0, color=0)
    assert torch.equal(augment(images(), np.random.default_rng(0)), images())


def test_augmentation_is_a_function_of_its_generator():
    first = Augmentation()(images(), np.random.default_rng(1))
    assert torch.equal(first, Augmentation()(images(), np.random.default_rng(1)))
    assert not torch.equal(first, Augmentation()(images(), np.random.default_rng(2)))
    assert torch.equal(images(), images())


def test_shifts_repeat_the_edge_and_are_shared_by_observed_steps():
    source, shift = images(), 3
    augment = Augmentation(shift_px=shift, brightness=0, contrast=0, color=0)
    shifted = augment(source, np.random.default_rng(0)).numpy()
    padded = np.pad(source.numpy(), [(0, 0)] * 4 + [(shift, shift)] * 2, mode="edge")
    found = set()
    for sample in range(source.shape[0]):
        for view in range(source.shape[2]):
            matches = {
                (down, right)
                for down in range(2 * shift + 1)
                for right in range(2 * shift + 1)
                if np.array_equal(
                    padded[sample, :, view, :, down : down + 16, right : right + 20], shifted[sample, :, view]
                )
            }
            assert len(matches) == 1
            found |= matches
    assert len(found) > 5


def test_colors_are_affine_and_shared_by_observed_steps():
    augment = Augmentation(shift_px=0, brightness=0.2, contrast=0.3, color=0.2)
    ramp = torch.arange(256, dtype=torch.uint8).reshape(16, 16)
    source = ramp.expand(6, 2, 3, 3, 16, 16).contiguous()
    colored = augment(source, np.random.default_rng(0)).numpy().reshape(6, 2, 3, 3, 256).astype(int)
    np.testing.assert_array_equal(colored[:, 0], colored[:, 1])
    assert (np.diff(colored) >= 0).all()
    gray, slope = colored[..., 128], (colored[..., 158] - colored[..., 98]) / 60
    assert (np.abs(gray - 128) <= 0.2 * 255 + 1).all()
    assert (slope > 0.7 * 0.8 - 0.04).all()
    assert (slope < 1.3 * 1.2 + 0.04).all()
    assert slope.std() > 0.1
    assert gray.std() > 10
    np.testing.assert_array_equal(gray[..., 0], gray[..., 2])  # brightness is no color


@pytest.mark.parametrize("b", [1, 4, 7])
def test_colors_do_not_depend_on_the_block_size(b, monkeypatch):
    wanted = Augmentation()(images(b), np.random.default_rng(0))
    monkeypatch.setattr("imfvla.data.augment.BLOCK", 3)
    assert torch.equal(Augmentation()(images(b), np.random.default_rng(0)), wanted)


@pytest.mark.parametrize(
    ("options", "text"), [({"contrast": 1.0}, "must stay below"), ({"shift_px": -1}, "shift_px")]
)
def test_impossible_augmentation_is_refused(options, text):
    with pytest.raises(UserError, match=text):
        replace(Augmentation(), **options)


def test_threads_change_no_batch_and_no_order(windows):
    with loader(windows, prefetch=5) as one, loader(windows, prefetch=5, threads=3) as several:
        for expected, found in islice(zip(one, several, strict=True), 12):
            assert_same(found, expected)


def test_threads_prepare_batches_at_the_same_time(windows):
    both = threading.Barrier(2, timeout=60)

    def waits_for_another(batch, changes):
        both.wait()
        return batch

    with loader(windows, prefetch=3, threads=2) as batches:
        batches.finish_with(waits_for_another)
        assert len([next(batches) for _ in range(4)]) == 4


def test_a_loader_hands_out_what_its_batches_are_finished_with(windows):
    with loader(windows) as plain, loader(windows) as finished:
        finished.finish_with(lambda batch, changes: (batch, changes))
        for expected, (batch, changes) in islice(zip(plain, finished, strict=True), 4):
            assert torch.equal(changes.apply(batch.obs.images), expected.obs.images)


@pytest.mark.parametrize("shift_px", [0, 1, 10])
@pytest.mark.parametrize("colours", [{}, {"brightness": 0, "contrast": 0, "color": 0}, {"contrast": 0.8}])
def test_operators_of_tensors_change_pictures_as_a_cpu_does(shift_px, colours):
    augmentation, rng = Augmentation(shift_px=shift_px, **colours), np.random.default_rng(3)
    images = torch.from_numpy(rng.integers(0, 256, (6, 2, 3, 3, 20, 32), dtype=np.uint8))
    changes = augmentation.draw(images, rng)
    assert torch.equal(changes.as_tensors(images), changes.apply(images))
