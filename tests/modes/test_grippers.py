"""Hands that close and let go at steps that are known."""

import numpy as np
import pytest

from imfvla.modes.grippers import (
    Event,
    closed_by,
    closings,
    event_of,
    fates,
    grippers_of,
    measure_closings,
    release_delay,
)
from imfvla.tasks.bimanual_robot import bimanual_robot

GRIPPERS = LEFT, RIGHT = grippers_of(bimanual_robot((), (8, 8)))

PRED, EXEC, NEVER = 32, 16, 99
HANDOVER = Event(100, LEFT, RIGHT)


def chunk(closes: int, lets_go: int, *, ramp: int = 0) -> np.ndarray:
    """(Tp, 16): the left hand closes, over `ramp` steps that end there, and the right one, closed so far, lets go."""
    steps = np.arange(PRED)
    actions = np.zeros((PRED, 16), np.float32)
    actions[:, LEFT] = np.where(steps >= closes, 0.0, 1.0)
    actions[(steps >= closes - ramp) & (steps < closes), LEFT] = 0.6
    actions[:, RIGHT] = steps >= lets_go
    return actions


def found(*chunks: np.ndarray, event: Event = HANDOVER):
    return closings(np.stack(chunks)[None], [event])


@pytest.mark.parametrize(("left_closes", "right_opens", "expected"), [(30, 34, 4), (30, 30, 0), (30, 28, -2)])
def test_the_delay_is_counted_from_the_left_hand_closing(left_closes, right_opens, expected):
    actions = np.ones((50, 16), np.float32)
    actions[left_closes:, LEFT] = 0.0
    actions[10:right_opens, RIGHT] = 0.2
    assert release_delay(actions, LEFT, RIGHT) == expected


def test_hands_that_never_switch_have_no_delay():
    actions = np.ones((50, 16), np.float32)
    assert release_delay(actions, LEFT, RIGHT) is None
    actions[10:, RIGHT] = 0.0
    assert release_delay(actions, LEFT, RIGHT) is None


def test_the_event_of_a_demonstration_is_its_last_closing():
    actions = np.ones((50, 16), np.float32)
    assert event_of(actions, GRIPPERS) is None
    actions[10:34, RIGHT] = 0.0
    assert event_of(actions, GRIPPERS) == Event(10, RIGHT, None)
    actions[30:, LEFT] = 0.0
    assert event_of(actions, GRIPPERS) == Event(30, LEFT, RIGHT)
    actions[:, RIGHT] = 1.0  # never held anything: nothing to let go
    assert event_of(actions, GRIPPERS) == Event(30, LEFT, None)


def test_a_robot_with_one_gripper_has_nothing_to_let_go():
    actions = np.ones((50, 3), np.float32)
    actions[20:, 2] = 0.0
    assert event_of(actions, (2,)) == Event(20, 2, None)


def test_samples_that_do_as_the_demonstrations_do_have_no_fault():
    row = measure_closings(found(chunk(5, 9), chunk(20, 24), chunk(30, NEVER), chunk(NEVER, NEVER)), EXEC)
    assert row == {"closes": 0.25, "in_order": 1.0, "lets_go": 0.0, "between": 0.0}


def test_each_fault_is_counted_where_it_belongs():
    faults = {
        "lets go": [chunk(20, 18), chunk(20, 21), chunk(NEVER, 8)],
        "holds on": [chunk(4, NEVER)],
        "between": [chunk(20, 24, ramp=4)],
        "closes": [chunk(20, 24, ramp=3), chunk(28, NEVER)],
        "waits": [chunk(NEVER, NEVER)],
    }
    for name, chunks in faults.items():
        shares = fates(found(*chunks))
        assert shares[name] == 1.0, name
        assert sum(shares.values()) == pytest.approx(1)
    row = measure_closings(found(*(c for chunks in faults.values() for c in chunks)), EXEC)
    assert row == {"closes": 1 / 8, "in_order": 2 / 5, "lets_go": 3 / 8, "between": 1 / 8}


def test_where_no_other_hand_lets_go_no_order_is_judged():
    row = measure_closings(found(chunk(5, 2), event=Event(100, LEFT, None)), EXEC)
    assert (row["closes"], row["in_order"], row["lets_go"]) == (1.0, None, None)


def test_each_observation_is_judged_by_its_own_event():
    chunks = np.stack([chunk(5, NEVER)] * 2)[:, None]
    both = closings(chunks, [Event(100, LEFT, None), Event(100, RIGHT, None)])
    assert both.closes.tolist() == [[5], [0]]


def test_the_curve_counts_what_has_closed_by_each_step():
    curve = closed_by(found(chunk(5, NEVER), chunk(NEVER, NEVER)))
    assert curve.tolist() == [0.0] * 5 + [0.5] * (PRED - 5)
