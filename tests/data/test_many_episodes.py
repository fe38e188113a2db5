"""Windows and statistics are computed in blocks: equal to those of an index that is held whole."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from any_robot import MemorySource, names_of, robot_of_size

from imfvla.config.horizon import Horizon
from imfvla.data import Augmentation, FrameStore, Loader, ResumableSampler, Statistics, Windows
from imfvla.data.statistics import RunningStatistics
from imfvla.types import tokenize

ROBOT = robot_of_size(7, 9)
HORIZONS = [(1, 1, 1), (1, 8, 4), (2, 8, 8), (3, 40, 5)]
CHOSEN = [None, (0, 2, 3, 5), (1, 3)]
ROUNDING = {"rtol": 1e-6, "atol": 1e-7}  # some units in the last place of float32


class Gaps(MemorySource):
    """Episodes of different lengths, sentences and steps with frames; one of them has no frames at all."""

    def __init__(self) -> None:
        super().__init__(ROBOT, num_episodes=6, num_steps=31)
        taken = (range(31), range(0, 31, 2), (), (0, 1, 2, 7, 8, 9, 20), range(1, 31), range(5))
        for number, (episode, steps) in enumerate(zip(self.episodes, taken, strict=True)):
            length = 31 - 3 * number
            kept = np.array([step for step in steps if step < length], np.int64)
            size = (len(kept), ROBOT.cameras[0].height, ROBOT.cameras[0].width, 3)
            pictures = np.random.default_rng(number).integers(256, size=size, dtype=np.uint8)
            sentences = ("move it", "push it", "move it", f"way {number // 2}")[: 1 + number]
            self.episodes[number] = replace(
                episode,
                state=episode.state[:length],
                action=episode.action[:length],
                image_steps=kept,
                images={ROBOT.cameras[0].name: pictures},
                instructions=sentences,
            )


class Failures(Gaps):
    """The same, with steps that are not to be imitated: at the beginning, at the end, and in the middle."""

    def __init__(self) -> None:
        super().__init__()
        skipped = ({*range(9)}, {0, 4, 5, 6, 13}, {3}, {*range(18, 31)}, set(), {2, 3, 9})
        for number, (episode, steps) in enumerate(zip(self.episodes, skipped, strict=True)):
            flags = np.array([step not in steps for step in range(len(episode.state))])
            self.episodes[number] = replace(episode, imitate=flags)


@pytest.fixture(scope="module", params=[Gaps, Failures])
def source(request: pytest.FixtureRequest) -> Gaps:
    return request.param()


@pytest.fixture(scope="module")
def store(source, tmp_path_factory) -> FrameStore:
    path = tmp_path_factory.mktemp("gaps") / "store"
    return FrameStore.build(source, path, (8, 8), names_of(ROBOT.cameras))


def flags_of(source: Gaps, number: int) -> np.ndarray:
    """bool (T,): which steps of an episode are to be imitated."""
    episode = source.episodes[number]
    return np.ones(len(episode.state), bool) if episode.imitate is None else episode.imitate


class Held:
    """The definition: one window after the other, all rows held in memory."""

    def __init__(self, source: Gaps, store: FrameStore, horizon: Horizon, paraphrases: bool, chosen) -> None:
        self.store = store
        episodes, steps, frames, observed, followed, valid = [], [], [], [], [], []
        for number in sorted(range(len(store.episodes)) if chosen is None else chosen):
            episode, flags = store.episodes[number], flags_of(source, number)
            frame_at = np.full(episode.num_steps, -1)
            frame_at[episode.image_steps] = episode.first_frame + np.arange(len(episode.image_steps))
            for step in episode.image_steps.tolist():
                seen = np.maximum(np.arange(step - horizon.obs + 1, step + 1), 0)
                if (frame_at[seen] < 0).any() or not flags[step]:
                    continue
                after = np.arange(step, step + horizon.pred)
                end = next((later for later in range(step, len(flags)) if not flags[later]), len(flags))
                episodes.append(number)
                steps.append(step)
                frames.append(frame_at[seen])
                observed.append(episode.first_row + seen)
                followed.append(episode.first_row + np.minimum(after, end - 1))
                valid.append(after < end)
        self.episodes, self.steps = np.array(episodes), np.array(steps)
        self.frames, self.observed, self.followed = np.array(frames), np.array(observed), np.array(followed)
        self.valid = np.array(valid)
        said = [
            list(dict.fromkeys(episode.instructions if paraphrases else episode.instructions[:1]))
            for episode in store.episodes
        ]
        self.first = np.cumsum([0, *map(len, said)])
        self.number = np.array([len(sentences) for sentences in said])
        self.words = np.stack([tokenize(sentence) for sentences in said for sentence in sentences])

    def batch(self, indices: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        episodes = self.episodes[indices]
        words = self.words[self.first[episodes] + rng.integers(self.number[episodes])]
        rows = self.store.state[self.observed[indices]], self.store.action[self.followed[indices]]
        return self.store.images[self.frames[indices]], words, *rows, self.valid[indices]


def parts(batch) -> tuple[torch.Tensor, ...]:
    return batch.obs.images, batch.obs.instruction, batch.obs.state, batch.actions, batch.valid


@pytest.mark.parametrize("chosen", CHOSEN)
@pytest.mark.parametrize("paraphrases", [True, False])
@pytest.mark.parametrize("horizon", HORIZONS)
def test_windows_and_batches_are_those_of_an_index_held_whole(source, store, horizon, paraphrases, chosen):
    horizon = Horizon(*horizon)
    windows = Windows(store, horizon, ROBOT, paraphrases=paraphrases, episodes=chosen)
    held = Held(source, store, horizon, paraphrases, chosen)
    assert len(windows) == len(held.steps)
    episodes, steps = windows.decisions(np.arange(len(windows)))
    np.testing.assert_array_equal(episodes, held.episodes)
    np.testing.assert_array_equal(steps, held.steps)
    sampler = ResumableSampler(len(windows), 5, seed=3)
    for number in range(2 * len(windows) // 5):
        indices = sampler.batch(number)
        found = parts(windows.batch(indices, np.random.default_rng(number)))
        for part, wanted in zip(found, held.batch(indices, np.random.default_rng(number)), strict=True):
            assert part.numpy().dtype == wanted.dtype
            np.testing.assert_array_equal(part.numpy(), wanted)
        state, actions, valid = windows.decided(indices)
        np.testing.assert_array_equal(state, store.state[held.observed[indices, -1]])
        np.testing.assert_array_equal(actions, found[3])
        np.testing.assert_array_equal(valid, found[4])


def test_a_loader_hands_out_the_same_batches(source, store):
    windows, held = (
        Windows(store, Horizon(2, 8, 4), ROBOT),
        Held(source, store, Horizon(2, 8, 4), True, None),
    )
    with Loader(windows, ResumableSampler(len(windows), 6, seed=1), augment=Augmentation()) as loader:
        for number in range(4):
            rng = np.random.default_rng(np.random.SeedSequence([1, 1, number]))
            images, *others = held.batch(ResumableSampler(len(windows), 6, seed=1).batch(number), rng)
            found = parts(next(loader))
            np.testing.assert_array_equal(found[0], Augmentation()(torch.from_numpy(images), rng))
            for part, wanted in zip(found[1:], others, strict=True):
                np.testing.assert_array_equal(part, wanted)


def assert_close(found: Statistics, wanted: Statistics) -> None:
    for name in Statistics.__slots__:
        part = getattr(found, name)
        assert part.dtype == np.float32
        limit = {"rtol": 0, "atol": 0} if name.endswith(("min", "max")) else ROUNDING
        np.testing.assert_allclose(part, getattr(wanted, name), **limit, err_msg=name)


@pytest.mark.parametrize("chosen", CHOSEN)
@pytest.mark.parametrize("horizon", [*HORIZONS, (1, 100, 1)])
def test_statistics_are_those_of_all_displacements_at_once(source, store, horizon, chosen):
    held = Held(source, store, Horizon(*horizon), True, chosen)
    numbers = range(len(store.episodes)) if chosen is None else chosen
    rows = np.concatenate(
        [store.episodes[number].first_row + np.flatnonzero(flags_of(source, number)) for number in numbers]
    )
    displaced = store.action[held.followed] - store.state[held.observed[:, -1:]][..., ROBOT.origin]
    wanted = Statistics.of(store.state[rows], store.action[rows], displaced, held.valid)
    assert_close(Windows(store, Horizon(*horizon), ROBOT, episodes=chosen).statistics(), wanted)


def test_what_is_not_to_be_imitated_enters_neither_a_batch_nor_the_statistics(tmp_path):
    """Neither actions nor states at such steps: with others, all batches and normalisers are the same."""
    batches, statistics, rng = [], [], np.random.default_rng(0)
    for name, scale in (("as recorded", 0), ("other", 100)):
        source = Failures()
        for number, episode in enumerate(source.episodes):
            bad = ~episode.imitate[:, None] * scale
            values = {
                key: (found + bad * rng.normal(size=found.shape)).astype(np.float32)
                for key, found in (("state", episode.state), ("action", episode.action))
            }
            source.episodes[number] = replace(episode, **values)
        store = FrameStore.build(source, tmp_path / name, (8, 8), names_of(ROBOT.cameras))
        windows = Windows(store, Horizon(1, 8, 4), ROBOT)
        batches.append(parts(windows.batch(np.arange(len(windows)), np.random.default_rng(0))))
        statistics.append(windows.statistics().to_json())
    assert all(torch.equal(one, other) for one, other in zip(*batches, strict=True))
    assert statistics[0] == statistics[1]


@pytest.mark.parametrize("far", [0.0, 1000.0])
def test_small_displacements_far_from_zero_keep_their_deviation(far):
    rng = np.random.default_rng(0)
    origin, pred, length = np.array([1, 1, 0]), 16, 90
    running = RunningStatistics(origin, pred)
    states, actions, displaced, valid = [], [], [], []
    for number in range(20):
        state = (far + number + rng.normal(size=(length, 2)).cumsum(axis=0)).astype(np.float32)
        action = state[:, origin] + np.float32([0.5, 0, 0]) + rng.normal(size=(length, 3)) * [0, 1e-3, 1]
        action = action.astype(np.float32)
        running.add(state, action, np.arange(length))
        steps = np.arange(length)[:, None] + np.arange(pred)
        states.append(state)
        actions.append(action)
        displaced.append(action[np.minimum(steps, length - 1)] - state[:, None, origin])
        valid.append(steps < length)
    whole = map(np.concatenate, (states, actions, displaced, valid))
    found, wanted = running.result(), Statistics.of(*whole)
    assert_close(found, wanted)


def test_a_channel_that_never_moves_has_no_deviation():
    running = RunningStatistics(np.zeros(1, int), 4)
    for _ in range(3):
        running.add(np.full((9, 1), 0.1, np.float32), np.full((9, 1), 0.7, np.float32), np.arange(9))
    found = running.result()
    assert (found.displacement_std == 0).all()
    assert found.state_std == found.action_std == 0
    np.testing.assert_allclose(found.displacement_mean, 0.6, rtol=1e-6)
