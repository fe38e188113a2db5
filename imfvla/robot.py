"""What a policy must know of a robot: its channels, limits, rate and cameras. Needs numpy only.

A `RobotSpec` comes from an environment or a data set and travels in recordings, run configs and checkpoints. No other
file holds a number of a robot. Shapes: S state channels, A action channels.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from imfvla.errors import UserError
from imfvla.options import build, require

FRAMES = RELATIVE, ABSOLUTE = "relative", "absolute"  # of the actions that a policy learns
MAX_CHANNELS = 1000
MAX_CAMERAS = 64
MIN_CONTROL_HZ, MAX_CONTROL_HZ = 0.01, 10_000.0
MAX_SIDE = 16_384  # of a picture [px]
UNIT = re.compile(r"(.*\S) \[([^\[\]]*)\]")  # "left/joint_1 [rad]"


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera and the size of the pictures that it takes [px]. A policy may see them at another size."""

    name: str
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """The channels of a robot in their order, their limits, its control rate and its cameras.

    state, action: names of the channels with their units in brackets, such as "left/joint_1 [rad]" or
      "gripper [0, 1]"; a slash groups channels in recordings. Names are unique within each.
    relative_to: for each action the index of the state channel that it is a displacement of in a policy's frame;
      None where it stays absolute, as grippers do.
    action_min, action_max: limits of the actions, in their units.
    control_hz: control steps per second.

    Raises UserError where the parts contradict each other.
    """

    state: tuple[str, ...]
    action: tuple[str, ...]
    relative_to: tuple[int | None, ...]
    action_min: tuple[float, ...]
    action_max: tuple[float, ...]
    control_hz: float
    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        for key in ("state", "action"):
            names = getattr(self, key)
            require(
                1 <= len(names) <= MAX_CHANNELS, f"robot.{key}", f"1 to {MAX_CHANNELS} channels", len(names)
            )
            plain = [bare_name(name) for name in names]
            repeated = sorted({name for name in plain if plain.count(name) > 1})
            require(
                not repeated, f"robot.{key}", "names that all differ", f"{', '.join(repeated)} more than once"
            )
            groups = {name[:place] for name in plain for place, sign in enumerate(name) if sign == "/"}
            shared = sorted(groups & set(plain))
            require(
                not shared,
                f"robot.{key}",
                "channels that are no group of others",
                f"{', '.join(shared)} as both",
            )
        for key in ("relative_to", "action_min", "action_max"):
            count = len(getattr(self, key))
            require(
                count == len(self.action),
                f"robot.{key}",
                f"{len(self.action)} values, one for each action",
                count,
            )
        for index in self.relative_to:
            fits = index is None or 0 <= index < len(self.state)
            require(fits, "robot.relative_to", f"null or the index of one of {len(self.state)} states", index)
        for name, low, high in zip(self.action, self.action_min, self.action_max, strict=True):
            is_range = math.isfinite(low) and math.isfinite(high) and low < high
            require(
                is_range,
                "robot.action_min, action_max",
                f"finite, the first below the second for {name}",
                (low, high),
            )
        require(
            MIN_CONTROL_HZ <= self.control_hz <= MAX_CONTROL_HZ,
            "robot.control_hz",
            f"from {MIN_CONTROL_HZ:g} to {MAX_CONTROL_HZ:g}",
            self.control_hz,
        )
        names = [camera.name for camera in self.cameras]
        require(len(names) <= MAX_CAMERAS, "robot.cameras", f"at most {MAX_CAMERAS}", len(names))
        require(len(set(names)) == len(names), "robot.cameras", "names that all differ", names)
        for camera in self.cameras:
            require(
                0 < min(camera.height, camera.width) <= max(camera.height, camera.width) <= MAX_SIDE,
                f"robot.cameras.{camera.name}",
                f"of 1 to {MAX_SIDE} pixels a side",
                camera,
            )

    @property
    def relative(self) -> np.ndarray:
        """Which actions are displacements of a state: bool (A,)."""
        return np.array([index is not None for index in self.relative_to])

    @property
    def origin(self) -> np.ndarray:
        """The state channel that each action is a displacement of, 0 where it is absolute: int64 (A,)."""
        return np.array([index or 0 for index in self.relative_to], np.int64)

    def camera(self, name: str) -> Camera:
        """The camera of this name. Raises UserError where there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras) or "none"
        raise UserError(
            f"There is no view {name!r}: the robot's cameras are {known}. Change observation.views."
        )

    def to_json(self) -> dict[str, Any]:
        """Plain lists and numbers; `from_json` gives an equal spec back."""
        plain = asdict(self)
        return {key: list(value) if isinstance(value, tuple) else value for key, value in plain.items()}

    @classmethod
    def from_json(cls, values: Any, where: str = "robot") -> "RobotSpec":
        """Inverse of `to_json`, for files and configs; `where` heads every message.

        Raises UserError naming what is missing, unknown or of another type.
        """
        if isinstance(values, Mapping) and "cameras" not in values:
            raise UserError(f"Missing key {where}.cameras: list its cameras, or [] for none.")
        return build(cls, values, where)


def bare_name(channel: str) -> str:
    """The name of a channel without its unit: "left/joint_1" of "left/joint_1 [rad]"."""
    found = UNIT.fullmatch(channel)
    return found.group(1) if found else channel


def unit_of(channel: str) -> str:
    """The unit of a channel: "rad" of "left/joint_1 [rad]", "" where it has none."""
    found = UNIT.fullmatch(channel)
    return found.group(2) if found else ""
