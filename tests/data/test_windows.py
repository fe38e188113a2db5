"""Known actions go through recording, store and windows, and come out where a policy would execute them."""

import numpy as np
import pytest
import torch
from synthetic import INSTRUCTION, PARAPHRASES, VIEWS, StillScene, synthetic_actions, write_demonstrations

from imfvla.config.horizon import Horizon
from imfvla.data import FrameStore, Statistics, Windows
from imfvla.errors import UserError
from imfvla.rollouts.clock import Clock
from imfvla.sources.mcap import McapSource
from imfvla.tasks.bimanual_robot import bimanual_robot
from imfvla.types import tokenize

ROBOT = bimanual_robot(VIEWS, (8, 8))
NUM_STEPS = 21
NUM_EPISODES = 2


def build(directory, camera_every: int) -> FrameStore:
    options = {"num_steps": NUM_STEPS, "image_size": (8, 8), "camera_every": camera_every}
    write_demonstrations(directory / "demonstrations", num_episodes=NUM_EPISODES, **options)
    return FrameStore.build(McapSource.of(directory / "demonstrations"), directory / "store", (8, 8), VIEWS)


@pytest.fixture(scope="module")
def dense(tmp_path_factory) -> FrameStore:
    """Frames at every control step."""
    return build(tmp_path_factory.mktemp("dense"), 1)


@pytest.fixture(scope="module")
def sparse(tmp_path_factory) -> FrameStore:
    """Frames at every second control step."""
    return build(tmp_path_factory.mktemp("sparse"), 2)


def whole(windows: Windows):
    """All windows in one batch."""
    return windows.batch(np.arange(len(windows)), np.random.default_rng(0))


def where(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Episode and step of every window."""
    return windows.decisions(np.arange(len(windows)))


HORIZONS = [(1, 1, 1), (1, 8, 4), (1, 16, 16), (2, 8, 4), (2, 8, 8), (3, 16, 5), (4, 32, 32)]


@pytest.mark.parametrize("horizon", HORIZONS)
def test_replaying_windows_gives_the_recorded_episode(dense, horizon):
    windows = Windows(dense, Horizon(*horizon), ROBOT)
    batch, (episodes, steps) = whole(windows), where(windows)
    assert len(windows) == NUM_EPISODES * NUM_STEPS
    for seed in range(NUM_EPISODES):
        executed = []
        for step in range(NUM_STEPS):
            if Clock(windows.horizon).is_decision(step):
                (row,) = np.flatnonzero((episodes == seed) & (steps == step))
                chunk = batch.actions[row][batch.valid[row]]
                executed.extend(chunk[: windows.horizon.exec])
        np.testing.assert_array_equal(np.stack(executed), synthetic_actions(seed, NUM_STEPS))


@pytest.mark.parametrize("horizon", HORIZONS)
def test_a_window_sees_what_a_rollout_would_see(dense, horizon):
    windows = Windows(dense, Horizon(*horizon), ROBOT)
    batch, (episodes, steps) = whole(windows), where(windows)
    scene = StillScene(bimanual_robot(VIEWS, (8, 8)))
    for row in range(0, len(windows), 5):
        recorded = synthetic_actions(int(episodes[row]), NUM_STEPS)
        for past, step in enumerate(windows.horizon.observed_steps(steps[row])):
            state = recorded[max(step - 1, 0)]
            np.testing.assert_array_equal(batch.obs.state[row, past], state)
            scene.position = state[0]
            for number, frame in enumerate(scene.look().values()):
                seen = batch.obs.images[row, past, number].permute(1, 2, 0)
                np.testing.assert_array_equal(seen, frame)


@pytest.mark.parametrize("horizon", HORIZONS)
def test_valid_ends_with_the_episode(dense, horizon):
    windows = Windows(dense, Horizon(*horizon), ROBOT)
    batch, (_, steps) = whole(windows), where(windows)
    left = torch.from_numpy(NUM_STEPS - steps).clamp(max=windows.horizon.pred)
    np.testing.assert_array_equal(batch.valid.sum(dim=1), left)
    assert batch.valid[:, 0].all()
    assert (batch.valid[:, 1:] <= batch.valid[:, :-1]).all()


def test_valid_actions_are_of_their_own_episode(dense):
    windows = Windows(dense, Horizon(1, 32, 16), ROBOT)
    batch, (episodes, steps) = whole(windows), where(windows)
    for row in range(len(windows)):
        recorded = synthetic_actions(int(episodes[row]), NUM_STEPS)[steps[row] :]
        np.testing.assert_array_equal(batch.actions[row][batch.valid[row]], recorded[:32])
        padding = batch.actions[row][~batch.valid[row]]
        np.testing.assert_array_equal(padding, np.broadcast_to(recorded[-1], padding.shape))


def test_sparse_frames_decide_where_they_are(sparse):
    windows = Windows(sparse, Horizon(1, 4, 2), ROBOT)
    assert where(windows)[1].tolist() == list(range(0, NUM_STEPS, 2)) * NUM_EPISODES


def test_sparse_frames_cannot_serve_two_consecutive_observations(sparse):
    with pytest.raises(UserError, match=r"horizon\.obs=2 .* set demos.camera_every=1, or horizon\.obs=1"):
        Windows(sparse, Horizon(2, 4, 2), ROBOT)


def test_a_batch_has_the_types_that_policies_expect(sparse):
    batch = Windows(sparse, Horizon(1, 4, 2), ROBOT).batch(np.array([3, 1]), np.random.default_rng(0))
    assert (batch.obs.images.dtype, batch.obs.images.shape) == (torch.uint8, (2, 1, 3, 3, 8, 8))
    assert (batch.obs.state.dtype, batch.obs.state.shape) == (torch.float32, (2, 1, 16))
    assert (batch.obs.instruction.dtype, batch.obs.instruction.shape) == (torch.int64, (2, 16))
    assert (batch.actions.dtype, batch.actions.shape) == (torch.float32, (2, 4, 16))
    assert (batch.valid.dtype, batch.valid.shape) == (torch.bool, (2, 4))
    assert batch.obs.images.is_contiguous()
    batch.obs.images.add_(1)  # a batch is its own memory: the store stays as it is


def test_instructions_are_drawn_among_an_episodes_sentences(sparse):
    windows = Windows(sparse, Horizon(1, 4, 2), ROBOT)
    drawn = windows.batch(np.zeros(400, int), np.random.default_rng(0)).obs.instruction
    expected = {tuple(tokenize(text)) for text in (INSTRUCTION, *PARAPHRASES)}
    assert set(map(tuple, drawn.tolist())) == expected
    again = windows.batch(np.zeros(400, int), np.random.default_rng(0)).obs.instruction
    assert torch.equal(drawn, again)
    windows = Windows(sparse, Horizon(1, 4, 2), ROBOT, paraphrases=False)
    said = windows.batch(np.zeros(9, int), np.random.default_rng(0)).obs.instruction
    assert (said == torch.from_numpy(tokenize(INSTRUCTION))).all()


def test_statistics_cover_every_control_step(sparse):
    statistics = Windows(sparse, Horizon(1, 4, 2), ROBOT).statistics()
    actions = np.concatenate([synthetic_actions(seed, NUM_STEPS) for seed in range(NUM_EPISODES)])
    np.testing.assert_array_equal(statistics.action_min, actions.min(axis=0))
    np.testing.assert_array_equal(statistics.action_max, actions.max(axis=0))
    np.testing.assert_allclose(statistics.action_mean, actions.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(statistics.action_std, actions.std(axis=0), atol=1e-6)
    assert statistics.state_min.shape == (16,)
    assert statistics.state_min.dtype == np.float32


def test_statistics_survive_json(sparse):
    statistics = Windows(sparse, Horizon(1, 4, 2), ROBOT).statistics()
    back = Statistics.from_json(statistics.to_json())
    for name in Statistics.__slots__:
        np.testing.assert_array_equal(getattr(back, name), getattr(statistics, name))
