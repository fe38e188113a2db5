"""Two robots are told apart by the first difference that matters to a policy, in one sentence."""

from dataclasses import replace

import pytest
from any_robot import robot_of_size

from imfvla.errors import UserError
from imfvla.robot import Camera
from imfvla.sources.same_robot import refuse_other_data, refuse_other_robot

ROBOT = robot_of_size(8, 9, num_cameras=2)
VIEWS = ("camera_0", "camera_1")
WORDS = {"of": "the policy", "where": "The data", "remedy": "Choose another."}


def test_a_robot_is_itself():
    refuse_other_robot(ROBOT, ROBOT, VIEWS, **WORDS)
    refuse_other_data(ROBOT, ROBOT, VIEWS, **WORDS)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (
            {"state": (*ROBOT.state[:-1], "part_8/force [N]")},
            r"state channel 8 must be part_8/position \[rad\], found",
        ),
        (
            {"state": (*ROBOT.state[:-1], "part_8/position [deg]")},
            r"state channel 8 must be .* \[rad\], found .* \[deg\]",
        ),
        ({"state": (*ROBOT.state, "more [m]")}, "the number of state channels must be 9, found 10"),
        ({"action": ("other [rad]", *ROBOT.action[1:])}, "action channel 0 must be .*target"),
        (
            {"relative_to": (None, *ROBOT.relative_to[1:])},
            "relative_to of part_0/target .* must be 1, found null",
        ),
        ({"action_max": (9.0, *ROBOT.action_max[1:])}, "action_max of part_0/target .* must be 4, found 9"),
        ({"control_hz": 30.0}, "control_hz must be 10, found 30"),
        (
            {"cameras": ROBOT.cameras[:1]},
            r"camera camera_1 must be there, found not among its cameras \(camera_0\)",
        ),
        (
            {"cameras": (ROBOT.cameras[0], Camera("camera_1", 16, 20))},
            "the proportions of camera camera_1 must be 16 x 16 pixels, found 16 x 20",
        ),
    ],
)
def test_the_first_difference_is_named(changes, named):
    other = replace(ROBOT, **changes)
    with pytest.raises(
        UserError, match=f"^The data has another robot than the policy: .*{named}.*Choose another"
    ):
        refuse_other_robot(ROBOT, other, VIEWS, **WORDS)


def test_pictures_of_another_size_but_the_same_proportions_are_resampled_not_refused():
    other = replace(
        ROBOT, cameras=(Camera("camera_0", 48, 64), Camera("camera_1", 8, 8), Camera("more", 9, 9))
    )
    refuse_other_robot(ROBOT, other, VIEWS, **WORDS)


def test_data_need_state_neither_units_nor_limits_nor_displacements():
    without = replace(
        ROBOT,
        state=tuple(name.partition(" ")[0] for name in ROBOT.state),
        relative_to=(None,) * 8,
        action_min=(-1.0,) * 8,
    )
    refuse_other_data(ROBOT, without, VIEWS, **WORDS)
    with pytest.raises(UserError, match="relative_to of part_0/target"):
        refuse_other_robot(ROBOT, without, VIEWS, **WORDS)


def test_of_data_both_values_and_both_places_are_said_since_either_may_be_wrong():
    words = {"of": "task.robot", "where": "the data", "remedy": "Correct one."}
    with pytest.raises(
        UserError,
        match=r"^Different robots: control_hz is 10 in task\.robot, but 30 in the data\. Correct one",
    ):
        refuse_other_data(ROBOT, replace(ROBOT, control_hz=30.0), VIEWS, **words)
