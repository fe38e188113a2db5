"""Wrists that roll by angles that are known."""

import numpy as np
import pytest

from imfvla.episode import ACTION_NAMES
from imfvla.modes.turns import STEPS, drawn_wrists, measure_turns, turns

WRIST = ACTION_NAMES.index("right/joint_7")


def test_wrists_are_those_whose_way_the_expert_draws():
    assert drawn_wrists(1) == ()
    assert drawn_wrists(2) == (WRIST,)
    assert [ACTION_NAMES[wrist] for wrist in drawn_wrists(4)] == ["left/joint_7", "right/joint_7"]


def test_rolls_count_from_the_state_and_at_one_step():
    chunks, state = np.zeros((2, 3, 32, 16)), np.zeros((2, 16))
    state[:, WRIST] = 0.1, -0.2
    chunks[:, :, STEPS - 1, WRIST] = state[:, None, WRIST] + np.array([0.2, -0.9, 0.5])
    chunks[:, :, STEPS:, WRIST] = 7.0
    found = turns(chunks, state, (WRIST,))
    assert found[..., 0] == pytest.approx(np.tile([0.2, -0.9, 0.5], (2, 1)))
    assert measure_turns(found) == pytest.approx({"bridge": 1 / 3, "arrived": 1 / 3, "amplitude": 1.6 / 3})
