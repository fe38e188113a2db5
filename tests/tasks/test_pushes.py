"""Demonstrations in which hands are pushed aside: how often, how far, and that nothing else is left out."""

import numpy as np
import pytest

from imfvla.errors import UserError
from imfvla.tasks.experts import make_expert
from imfvla.tasks.experts.push import ASIDE, STEPS, TURNED
from imfvla.tasks.kinematics import rotation_vector

STYLE = {"modes": 2, "noise": 0.004, "hold": 2, "dwell": 0}
ARM = {"left": slice(0, 7), "right": slice(8, 15)}


def play(env, expert, seed: int, most: int = 700):
    """Decisions of an episode, poses of both hands before each, and the last outcome."""
    env.reset(seed)
    expert.reset(env, seed)
    decisions, poses = [], []
    for step in range(most):
        poses.append({side: env.task.grip_pose(env.physics, side) for side in ARM})
        decisions.append(expert.act(env, env.state(), step))
        outcome = env.step(decisions[-1].executed)
        if expert.done(env):
            break
    return decisions, poses, outcome


def spans(flags: np.ndarray) -> list[tuple[int, int]]:
    """[first, end) of the steps at which it holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def test_each_hand_is_pushed_so_often_and_nothing_but_that_is_not_imitated(socket_env):
    expert = make_expert("socket", pushes=2, **(STYLE | {"noise": 0}))
    decisions, poses, outcome = play(socket_env, expert, 31)
    assert outcome.success
    apart = {
        side: np.array(
            [not np.array_equal(one.action[arm], one.executed[arm]) for one in decisions], dtype=bool
        )
        for side, arm in ARM.items()
    }
    imitate = np.array([one.imitate for one in decisions])
    assert np.array_equal(imitate, ~(apart["left"] | apart["right"]))
    for side, pushed in apart.items():
        assert pushed.sum() == 2 * STEPS
        for first, end in spans(pushed):
            before, after = poses[first][side], poses[end][side]
            moved = np.linalg.norm((after.position - before.position)[:2])
            turned = np.linalg.norm(rotation_vector(after.rotation @ before.rotation.T))
            assert 0.001 < moved < ASIDE + 0.005
            assert 0.01 < turned < TURNED + 0.05


def test_what_is_imitated_after_a_push_brings_the_hand_back(socket_env):
    expert = make_expert("socket", pushes=1, **(STYLE | {"noise": 0}))
    decisions, poses, _ = play(socket_env, expert, 32)
    for side, arm in ARM.items():
        pushed = np.array([not np.array_equal(one.action[arm], one.executed[arm]) for one in decisions])
        ((first, end),) = spans(pushed)
        back = poses[end][side].position - poses[first][side].position
        kinematics = expert.hands[side]._kinematics
        commanded = kinematics.pose(decisions[end].action[arm].astype(float)).position
        assert (commanded - poses[end][side].position)[:2] @ back[:2] < 0
        later = poses[end + 15][side].position - poses[first][side].position
        assert np.linalg.norm(later[:2]) < np.linalg.norm(back[:2])


def test_an_expert_that_is_not_pushed_is_one_that_was_never_asked(transfer_env):
    first, second = make_expert("transfer", pushes=0, **STYLE), make_expert("transfer", **STYLE)
    decisions, _, _ = play(transfer_env, first, 3, 150)
    before, _, _ = play(transfer_env, second, 3, 150)
    assert first.style == second.style
    for one, other in zip(decisions, before, strict=True):
        assert np.array_equal(one.executed, other.executed)
        assert one.imitate is other.imitate is None


def test_pushes_change_neither_start_nor_style(socket_env):
    pushed, usual = (make_expert("socket", pushes=count, **STYLE) for count in (3, 0))
    for expert in (pushed, usual):
        socket_env.reset(33)
        expert.reset(socket_env, 33)
    assert pushed.style == usual.style


@pytest.mark.parametrize("pushes", [-1, 11, 1.5])
def test_a_number_of_pushes_is_whole_and_small(pushes):
    with pytest.raises(UserError, match=r"task\.expert\.pushes is a whole number from 0 to 10 for each hand"):
        make_expert("socket", pushes=pushes, **STYLE)
