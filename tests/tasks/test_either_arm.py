"""What makes either_arm a task on which averages fail: until one hand lets go, both do the same."""

from collections.abc import Iterator

import numpy as np
import pytest

from imfvla import tasks
from imfvla.tasks.bimanual import SIDES
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.either_arm import EitherArmExpert

SEED = 4
GRIPPERS = [7, 15]  # of the left and of the right arm


@pytest.fixture(scope="module")
def either_env() -> Iterator[BimanualEnvironment]:
    env = tasks.load("either_arm", variant="easy")
    yield env
    env.close()


def begin(env: BimanualEnvironment, giver: str) -> EitherArmExpert:
    expert = EitherArmExpert(modes=1, noise=0.0, hold=18, dwell=8)
    env.reset(SEED)
    expert.reset(env, SEED)
    expert.giver, expert.wait = giver, 3
    return expert


def play(env: BimanualEnvironment, giver: str) -> tuple[np.ndarray, list[int]]:
    """Actions and stages of an episode in which this arm gives."""
    expert = begin(env, giver)
    actions, stages = [], []
    for step in range(400):
        actions.append(expert.act(env, env.state(), step).executed)
        env.step(actions[-1])
        stages.append(env.stage())
        if expert.done(env):
            break
    return np.array(actions), stages


def test_neither_hand_shows_its_intention_before_one_lets_go(either_env):
    (left, stages_left), (right, stages_right) = (play(either_env, side) for side in SIDES)
    shared = min(len(left), len(right))
    parts = int(np.flatnonzero((left[:shared] != right[:shared]).any(axis=1))[0])
    opened = left[parts, GRIPPERS] > 0.5, right[parts, GRIPPERS] > 0.5
    assert [list(o) for o in opened] == [[True, False], [False, True]]
    assert (left[parts - 10 : parts, GRIPPERS] == 0).all()
    assert max(stages_left[:parts]) == max(stages_right[:parts]) == 3
    assert stages_left[-1] == stages_right[-1] == len(either_env.stages)


@pytest.mark.parametrize(("opening", "falls"), [(0.43, True), (0.5, True), (0.0, False)])
def test_the_mean_of_both_lets_the_bar_fall_and_the_median_never_lets_go(either_env, opening, falls):
    """By the 16th step either hand has let go with a probability of 0.44: less than a half, more than a bar's width."""
    expert = begin(either_env, "left")
    expert.wait = 1000
    stages = []
    for step in range(260):
        action = expert.act(either_env, either_env.state(), step).executed
        if expert._in_place > 5:
            action[GRIPPERS] = opening
        either_env.step(action)
        stages.append(either_env.stage())
    assert max(stages) == 3
    assert (stages[-1] == 3) != falls


def test_an_arm_that_lifts_the_bar_alone_is_at_the_first_stage(either_env):
    expert = begin(either_env, "left")
    stages = []
    for step in range(260):
        action = expert.act(either_env, either_env.state(), step).executed
        if max(stages, default=0) < 2 and stages[-5:].count(1) != 5:
            action[GRIPPERS[1]] = 1.0  # the right hand stays open until the left one has the bar
            either_env.step(action)
        else:
            left = expert.hands["left"]
            goal = type(left.pose)(left.pose.position + [0, 0, 0.01], left.pose.rotation)
            left.move(goal, 0.0, expert.speed)
            still = either_env.state()
            either_env.step(np.concatenate([left.command, still[8:15], [1.0]]))
        stages.append(either_env.stage())
    bar = either_env.task.prop_pose(either_env.physics, "bar").position
    assert bar[2] > 0.06
    assert max(stages) == stages[-1] == 1
    assert not either_env.task.shared
