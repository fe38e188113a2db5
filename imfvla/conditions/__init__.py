"""Conditions: changes of the world at evaluation alone, by name and severity.

Each is drawn from the episode's seed and nothing else, so that all policies meet the same change, and the start state
stays that of the unchanged world, so that episodes are pairs. A condition is one class in `sensing` (for any
environment) or `physical` (for those with a simulator's bodies), one line here, its name in `config.condition` and one
file in conf/condition.
"""

from importlib import import_module

from imfvla.conditions.change import Change, ChangedWorld
from imfvla.config.condition import NONE
from imfvla.environment import Environment
from imfvla.errors import UserError

CHANGES = {
    "camera_pose": "physical.CameraPose",
    "light": "sensing.Light",
    "pixel_noise": "sensing.PixelNoise",
    "blur": "sensing.Blur",
    "dropped_frames": "sensing.DroppedFrames",
    "joint_bias": "sensing.JointBias",
    "action_lag": "sensing.ActionLag",
    "friction": "physical.Friction",
    "mass": "physical.Mass",
    "object_size": "physical.ObjectSize",
    "distractors": "sensing.Distractors",
    "bump": "physical.Bump",
}


def change_of(name: str) -> type[Change]:
    """The class of a condition; its module is imported now, since some of them simulate."""
    module, _, kind = CHANGES[name].partition(".")
    return getattr(import_module(f"imfvla.conditions.{module}"), kind)


def changed(env: Environment, name: str, severity: int | None) -> Environment:
    """The environment under a condition; with "none" that environment itself.

    Raises UserError where the environment does not have what the condition changes.
    """
    if name == NONE:
        return env
    change = change_of(name)(severity)
    lacking = change.lacking(env)
    if lacking is not None:
        raise UserError(
            f"condition={name} needs {lacking}, which the environment {env.name} does not have: choose another "
            "condition."
        )
    return ChangedWorld(env, change)
