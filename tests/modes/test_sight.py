"""Whether a policy looks: of one that knows where the object is, and of one that goes on from where it is."""

from collections.abc import Iterator

import numpy as np
import pytest

from imfvla import tasks
from imfvla.modes.sight import AHEAD, EARLY, LEADS, Pick, foresee, half_turns, picks_of, probe
from imfvla.tasks.bimanual import Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts import make_expert
from imfvla.tasks.experts.hand import ARM
from imfvla.tasks.kinematics import about_z, yaw_of

SEED = 3


@pytest.fixture(scope="module")
def env() -> Iterator[BimanualEnvironment]:
    env = tasks.load("socket", image_size=(8, 8))
    yield env
    env.close()


@pytest.fixture
def expert():
    return make_expert("socket", modes=2, noise=0, hold=1, dwell=0)


def test_what_hands_take_is_what_the_expert_goes_for(env, expert):
    env.reset(SEED)
    expert.reset(env, SEED)
    picks = picks_of(env, expert)
    assert {side: pick.prop for side, pick in picks.items()} == {"left": "socket", "right": "peg"}
    assert picks["right"].local.tolist() == [expert.peg_offset, 0, 0]
    assert isinstance(picks["left"], Pick)
    assert "pick" not in vars(expert)


def test_one_that_goes_on_from_where_it_is_follows_the_hand_alone(env, expert):
    def plan(images: dict[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        return np.repeat(state[None], 32, axis=0)

    rows = probe(env, expert, plan, SEED)
    assert {(row["hand"], row["lead"]) for row in rows} == {(hand, lead) for hand in ARM for lead in LEADS}
    for row in rows:
        assert row["object aside"] == row["object turned"] == 0
        assert row["hand aside"] == pytest.approx(1, abs=0.05)
        assert row["hand turned"] == pytest.approx(1, abs=0.02)


def test_one_that_sees_the_object_follows_it_alone(env, expert):
    kept = {}

    def plan(images: dict[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        chunk = np.repeat(state[None], 32, axis=0)
        for side, pick in kept["picks"].items():
            goal = pick.goal(env)
            yaw = yaw_of(goal.rotation) + expert.turn[side] * np.pi / 2
            joints = state[ARM[side]].astype(float)
            chunk[:, ARM[side]] = expert.hands[side]._kinematics.solve(
                Pose(goal.position, about_z(yaw)), joints, max_iterations=200
            )
        return chunk

    env.reset(SEED)
    expert.reset(env, SEED)
    kept["picks"] = picks_of(env, expert)
    for row in probe(env, expert, plan, SEED):
        assert row["object aside"] == pytest.approx(1, abs=0.05)
        assert row["object turned"] == pytest.approx(1, abs=0.05)
        assert row["hand aside"] == pytest.approx(0, abs=0.05)
        assert row["hand turned"] == pytest.approx(0, abs=0.05)
        assert abs(row["aside"]) < 1e-3
        assert abs(row["above"]) < 1e-3
        assert abs(row["turned"]) < 0.01


def test_early_chunks_are_compared_with_what_the_expert_does(env, expert):
    commands = []
    env.reset(SEED)
    expert.reset(env, SEED)
    for step in range(EARLY[-1] + AHEAD + 1):
        commands.append(expert.act(env, env.state(), step).action)
        env.step(commands[-1])
    coming = iter(EARLY)

    def plan(images: dict[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        step = next(coming)
        chunk = np.array(commands[step : step + AHEAD + 1])
        chunk[:, 6] += 0.1  # the left wrist's roll, about the vertical
        return chunk

    rows = foresee(env, expert, plan, SEED)
    assert {row["hand"] for row in rows} == set(ARM)
    for row in rows:
        assert abs(row["turned"]) == pytest.approx(0.1 if row["hand"] == "left" else 0, abs=0.005)
    yaw = {side: pick.goal(env).rotation for side, pick in picks_of(env, expert).items()}
    last = {row["hand"]: row["wanted"] for row in rows}
    assert all(last[side] == pytest.approx(yaw_of(yaw[side]), abs=0.02) for side in last)


def test_half_a_turn_is_none_to_a_gripper():
    assert half_turns(np.pi + 0.1) == pytest.approx(0.1)
    assert half_turns(-np.pi / 2 - 0.1) == pytest.approx(np.pi / 2 - 0.1)
