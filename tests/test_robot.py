"""RobotSpec: round trips, and the sentence for every part that contradicts another."""

from dataclasses import replace

import numpy as np
import pytest

from imfvla.errors import UserError
from imfvla.robot import Camera, RobotSpec, bare_name, unit_of

SPEC = RobotSpec(
    state=("shoulder [rad]", "elbow [rad]", "gripper [0, 1]"),
    action=("elbow [rad]", "gripper [0, 1]"),
    relative_to=(1, None),
    action_min=(-2.0, 0.0),
    action_max=(2.0, 1.0),
    control_hz=10.0,
    cameras=(Camera("front", 48, 64), Camera("wrist", 32, 32)),
)


def test_json_gives_an_equal_spec_back():
    assert RobotSpec.from_json(SPEC.to_json()) == SPEC


def test_the_origin_of_an_action_is_the_state_that_it_displaces():
    np.testing.assert_array_equal(SPEC.relative, [True, False])
    np.testing.assert_array_equal(SPEC.origin, [1, 0])


@pytest.mark.parametrize(
    ("channel", "name", "unit"),
    [("a/b [rad]", "a/b", "rad"), ("gripper [0, 1]", "gripper", "0, 1"), ("x", "x", "")],
)
def test_a_channel_is_a_name_and_a_unit(channel, name, unit):
    assert (bare_name(channel), unit_of(channel)) == (name, unit)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"state": ()}, "robot.state must be 1 to 1000 channels, found 0"),
        (
            {"state": ("a [rad]", "a [m]", "b")},
            "robot.state must be names that all differ, found 'a more than once'",
        ),
        (
            {"state": ("a [rad]", "a/b [rad]", "c")},
            "robot.state must be channels that are no group of others, found 'a as both'",
        ),
        ({"relative_to": (1,)}, "robot.relative_to must be 2 values"),
        (
            {"relative_to": (3, None)},
            "robot.relative_to must be null or the index of one of 3 states, found 3",
        ),
        ({"action_max": (-2.0, 1.0)}, "robot.action_min, action_max"),
        ({"control_hz": 0.0}, "robot.control_hz"),
        ({"cameras": (Camera("front", 4, 4), Camera("front", 8, 8))}, "robot.cameras"),
        ({"cameras": (Camera("front", 0, 4),)}, "robot.cameras.front"),
    ],
)
def test_a_contradiction_is_named(changes, named):
    with pytest.raises(UserError) as error:
        replace(SPEC, **changes)
    assert named in str(error.value)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        (None, "robot"),
        ({}, "robot.cameras"),
        (SPEC.to_json() | {"control_hz": "fast"}, "robot.control_hz must be a finite number, found 'fast'"),
        (SPEC.to_json() | {"cameras": [{"name": "front"}]}, "robot.cameras[0].height"),
        (SPEC.to_json() | {"speed": 1}, "Unknown key robot.speed"),
    ],
)
@pytest.mark.parametrize("where", ["robot", "task.robot"])
def test_a_wrong_file_is_named(values, named, where):
    with pytest.raises(UserError) as error:
        RobotSpec.from_json(values, where)
    assert named.replace("robot", where) in str(error.value)


def test_a_part_of_a_config_is_read():
    assert RobotSpec.from_json(SPEC.to_json(), "task.robot") == SPEC


def test_an_unknown_camera_is_answered_with_the_known_ones():
    with pytest.raises(UserError, match="front, wrist"):
        SPEC.camera("top")
