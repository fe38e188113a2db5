"""Demonstrations in which a first grasp fails: what is missed, what is imitated, and that nothing else changes."""

from dataclasses import asdict

import numpy as np
import pytest

from imfvla.errors import UserError
from imfvla.tasks.experts import make_expert

GRIPPERS = {"left": 7, "right": 15}
STYLE = {"modes": 2, "noise": 0.004, "hold": 18, "dwell": 0}


def play(env, expert, seed: int, most: int = 700):
    """States before each step, decisions, and the last outcome of an episode of at most so many steps."""
    env.reset(seed)
    expert.reset(env, seed)
    states, decisions = [], []
    for step in range(most):
        states.append(env.state())
        decisions.append(expert.act(env, states[-1], step))
        outcome = env.step(decisions[-1].executed)
        if expert.done(env):
            break
    return np.array(states), decisions, outcome


def assert_equal(decisions, others) -> None:
    assert len(decisions) == len(others)
    for one, other in zip(decisions, others, strict=True):
        assert np.array_equal(one.action, other.action)
        assert np.array_equal(one.executed, other.executed)
        assert one.imitate == other.imitate


def test_a_hand_closes_around_nothing_and_what_follows_is_to_be_imitated(env):
    expert = make_expert(env.name, recoveries=1, **STYLE)
    for seed in (21, 22):
        states, decisions, outcome = play(env, expert, seed)
        assert outcome.success
        imitate = np.array([decision.imitate for decision in decisions])
        first = int(np.argmax(imitate))
        assert first > 30
        assert not imitate[:first].any()
        assert imitate[first:].all()
        commands = np.array([decision.action for decision in decisions])
        for side in expert.style["missed"]:
            channel = GRIPPERS[side]
            closings = np.flatnonzero(np.diff(commands[:, channel]) < -0.5)
            assert len(closings) >= 2  # a hand that gives something away may close no more
            assert states[:first, channel].min() < 0.05
            assert closings[0] < first
        # The last hand to notice is closed around nothing, which a policy can see, and now opens.
        noticed = min(expert.style["missed"], key=lambda side: states[first, GRIPPERS[side]])
        assert states[first, GRIPPERS[noticed]] < 0.05
        assert commands[first, GRIPPERS[noticed]] == 1


def test_the_seed_decides_everything(socket_env):
    first, second = (make_expert("socket", recoveries=1, **STYLE) for _ in range(2))
    _, decisions, _ = play(socket_env, first, 23, 150)
    _, again, _ = play(socket_env, second, 23, 150)
    assert first.style == second.style
    assert_equal(decisions, again)


def test_a_share_of_the_demonstrations_is_drawn_and_the_others_are_what_they_were(socket_env):
    expert, usual = (make_expert("socket", recoveries=share, **STYLE) for share in (0.3, 0))
    missed = []
    for seed in range(150):
        for one in (expert, usual):
            one.reset(socket_env, seed)
        missed.append(tuple(expert.style.pop("missed", ())))
        assert expert.style == usual.style
    assert np.mean([bool(sides) for sides in missed]) == pytest.approx(0.3, abs=0.08)
    assert set(missed) == {(), ("left",), ("right",), ("left", "right")}
    seed = missed.index(())
    _, decisions, _ = play(socket_env, expert, seed, 150)
    _, before, _ = play(socket_env, usual, seed, 150)
    assert_equal(decisions, before)
    assert all(decision.imitate is None for decision in decisions)


def test_an_expert_without_recoveries_is_one_that_was_never_asked(transfer_env):
    _, decisions, _ = play(transfer_env, make_expert("transfer", recoveries=0, **STYLE), 3, 150)
    _, before, _ = play(transfer_env, make_expert("transfer", **STYLE), 3, 150)
    assert_equal(decisions, before)
    assert {asdict(decision)["imitate"] for decision in decisions} == {None}


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_is_between_none_and_all(share):
    with pytest.raises(UserError, match=r"task\.expert\.recoveries is a share of the demonstrations, 0 to 1"):
        make_expert("socket", recoveries=share, **STYLE)
