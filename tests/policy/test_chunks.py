import numpy as np
import pytest
import torch
from any_robot import robot_of_size

from imfvla.data.statistics import Statistics
from imfvla.errors import UserError
from imfvla.policy.chunks import MIN_SCALE, ChunkFrame
from imfvla.robot import RobotSpec
from imfvla.tasks.bimanual_robot import bimanual_robot

STEPS, CHANNELS = 4, 16
ARMS = bimanual_robot((), (8, 8))


def example(rows=200):
    rng = np.random.default_rng(0)
    state = rng.normal(size=(rows, CHANNELS)).astype(np.float32)
    action = (state[:, None] + 0.1 * rng.normal(size=(rows, STEPS, CHANNELS))).astype(np.float32)
    valid = np.ones((rows, STEPS), bool)
    statistics = Statistics.of(state, action[:, 0], action - state[:, None], valid)
    return torch.from_numpy(state), torch.from_numpy(action), statistics


def fitted(frame):
    state, action, statistics = example()
    made = ChunkFrame(frame, STEPS, ARMS)
    made.fit(statistics)
    return made, state, action


@pytest.mark.parametrize("frame", ["relative", "absolute"])
def test_there_and_back(frame):
    made, state, action = fitted(frame)
    torch.testing.assert_close(
        made.denormalise(made.normalise(action, state), state), action, rtol=1e-4, atol=1e-5
    )


def test_relative_joints_are_standardised_at_every_step():
    made, state, action = fitted("relative")
    joints = made.normalise(action, state)[..., :7]
    torch.testing.assert_close(joints.mean(0), torch.zeros(STEPS, 7), atol=1e-4, rtol=0)
    torch.testing.assert_close(joints.std(0, correction=0), torch.ones(STEPS, 7), atol=1e-3, rtol=0)


def test_a_relative_chunk_moves_with_the_arm_and_its_grippers_do_not():
    made, state, _ = fitted("relative")
    chunk = torch.zeros(1, STEPS, CHANNELS)
    moved = made.denormalise(chunk, state[:1] + 0.25) - made.denormalise(chunk, state[:1])
    grippers = torch.tensor([7, 15])
    expected = torch.full((1, STEPS, CHANNELS), 0.25).index_fill(2, grippers, 0.0)
    torch.testing.assert_close(moved, expected)


def test_an_absolute_chunk_does_not_depend_on_the_state():
    made, state, action = fitted("absolute")
    assert torch.equal(made.normalise(action, state), made.normalise(action, state + 1))


def test_two_arms_of_six_joints_have_all_joints_relative_and_both_grippers_absolute():
    """14 channels, as ALOHA has: nothing may be guessed from the 16 of our own tasks."""
    arm = (*(f"joint_{number} [rad]" for number in range(1, 7)), "gripper [0, 1]")
    channels = tuple(f"{side}/{name}" for side in ("left", "right") for name in arm)
    aloha = RobotSpec(
        state=channels,
        action=channels,
        relative_to=tuple(None if index in (6, 13) else index for index in range(14)),
        action_min=(-3.0,) * 14,
        action_max=(3.0,) * 14,
        control_hz=50.0,
        cameras=(),
    )
    made = ChunkFrame("relative", STEPS, aloha)
    made.normaliser.fit(torch.zeros(STEPS, 14), torch.ones(STEPS, 14), MIN_SCALE)
    moved = made.denormalise(torch.zeros(1, STEPS, 14), torch.full((1, 14), 0.25))
    expected = torch.full((1, STEPS, 14), 0.25).index_fill(2, torch.tensor([6, 13]), 0.0)
    assert torch.equal(moved, expected)


def test_an_action_may_displace_a_state_of_another_index_and_number():
    robot = robot_of_size(8, 9)
    made = ChunkFrame("relative", STEPS, robot)
    made.normaliser.fit(torch.zeros(STEPS, 8), torch.ones(STEPS, 8), MIN_SCALE)
    state = torch.arange(9.0).unsqueeze(0)
    chunk = made.denormalise(torch.zeros(1, STEPS, 8), state)
    assert chunk[0, 0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 8.0]
    assert torch.equal(made.normalise(chunk, state), torch.zeros(1, STEPS, 8))


def test_still_channels_are_not_blown_up():
    state, action, _ = example()
    still = Statistics.of(
        state.numpy(), state.numpy(), np.zeros(action.shape), np.ones(action.shape[:2], bool)
    )
    made = ChunkFrame("relative", STEPS, ARMS)
    made.fit(still)
    assert made.normaliser.scale[:, 0].tolist() == pytest.approx([MIN_SCALE] * STEPS)


def test_steps_that_are_not_valid_leave_the_statistics_alone():
    state, action, _ = example()
    displacement = (action - state[:, None]).numpy()
    valid = np.ones(displacement.shape[:2], bool)
    valid[100:, 2:] = False
    damaged = displacement.copy()
    damaged[~valid] = 1e6
    found = Statistics.of(state.numpy(), state.numpy(), damaged, valid)
    np.testing.assert_allclose(
        found.displacement_mean[2], displacement[:100, 2].mean(0), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(found.displacement_std[3], displacement[:100, 3].std(0), rtol=1e-4)


def test_an_unknown_frame_is_refused():
    with pytest.raises(UserError, match="action_frame must be relative or absolute, found 'polar'"):
        ChunkFrame("polar", STEPS, ARMS)
