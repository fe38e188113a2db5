"""tools/handover.py: the delay until the right hand opens, against values computed by hand."""

import numpy as np
import pytest
from test_hostile_files import load_tool

release_delay = load_tool("handover").release_delay


@pytest.mark.parametrize(("left_closes", "right_opens", "expected"), [(30, 34, 4), (30, 30, 0), (30, 28, -2)])
def test_the_delay_is_counted_from_the_left_hand_closing(left_closes, right_opens, expected):
    actions = np.ones((50, 16), np.float32)
    actions[left_closes:, 7] = 0.0
    actions[10:right_opens, 15] = 0.2
    assert release_delay(actions) == expected


def test_hands_that_never_switch_have_no_delay():
    actions = np.ones((50, 16), np.float32)
    assert release_delay(actions) is None
    actions[10:, 15] = 0.0
    assert release_delay(actions) is None
