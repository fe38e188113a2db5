"""Wrists that roll by angles that are known."""

import numpy as np
import pytest

from imfvla.modes.turns import STEPS, drawn_wrists, measure_turns, turns
from imfvla.robot import bare_name
from imfvla.tasks.bimanual_robot import bimanual_robot

ROBOT = bimanual_robot((), (8, 8))
NAMES = [bare_name(channel) for channel in ROBOT.action]
WRIST = NAMES.index("right/joint_7")


def test_wrists_are_those_whose_way_the_expert_draws():
    assert drawn_wrists(1, ROBOT) == ()
    assert drawn_wrists(2, ROBOT) == (WRIST,)
    assert [NAMES[wrist] for wrist in drawn_wrists(4, ROBOT)] == ["left/joint_7", "right/joint_7"]


def test_rolls_count_from_the_state_and_at_one_step():
    chunks, state = np.zeros((2, 3, 32, 16)), np.zeros((2, 16))
    state[:, WRIST] = 0.1, -0.2
    chunks[:, :, STEPS - 1, WRIST] = state[:, None, WRIST] + np.array([0.2, -0.9, 0.5])
    chunks[:, :, STEPS:, WRIST] = 7.0
    found = turns(chunks, state, (WRIST,))
    assert found[..., 0] == pytest.approx(np.tile([0.2, -0.9, 0.5], (2, 1)))
    assert measure_turns(found) == pytest.approx({"bridge": 1 / 3, "arrived": 1 / 3, "amplitude": 1.6 / 3})
