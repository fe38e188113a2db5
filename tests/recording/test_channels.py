"""Channels as nested JSON: what is written comes back, and what does not fit is named."""

import numpy as np
import pytest

from imfvla.recording.channels import Channels, Misfit

NAMES = ("arm/left/joint [rad]", "arm/right/joint [rad]", "gripper [0, 1]")
TREE = {"arm": {"left": {"joint": 1.5}, "right": {"joint": None}}, "gripper": 0.0}


def test_slashes_nest_and_units_are_dropped():
    channels = Channels(NAMES)
    assert channels.tree(np.array([1.5, np.nan, 0.0])) == TREE
    assert channels.values(TREE) == [1.5, None, 0.0]
    assert channels.values({"gripper": 0.0, "arm": TREE["arm"]}) == [1.5, None, 0.0]
    schema = channels.schema("State")
    assert schema["properties"]["arm"]["properties"]["left"]["title"] == "State.arm.left"
    assert schema["properties"]["gripper"] == {"type": "number"}


def test_values_of_another_number_are_not_written():
    with pytest.raises(ValueError, match="Wanted 3 values, found 2"):
        Channels(NAMES).tree(np.zeros(2))


@pytest.mark.parametrize(
    ("tree", "named"),
    [
        ({"arm": TREE["arm"]}, "gripper must be there, found only arm/left/joint, arm/right/joint"),
        ({**TREE, "rail": 1.0}, "rail must be absent from the 3 channels, found a value"),
        ({**TREE, "gripper": "0.5"}, "gripper must be a number, found '0.5'"),
        ({**TREE, "gripper": {"a": 1.0}}, "gripper must be there, found only"),
        ({**TREE, "gripper": True}, "gripper must be a number, found True"),
        ([1.5, 0.0, 0.0], "arm/left/joint must be there"),
    ],
)
def test_a_message_of_other_channels_is_named(tree, named):
    with pytest.raises(Misfit) as error:
        Channels(NAMES).values(tree)
    assert named in str(error.value)
