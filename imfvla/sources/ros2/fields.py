"""Numbers and pictures in ROS 2 messages: joints by name, arrays by place, any other field by its path."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np

from imfvla.errors import UserError
from imfvla.options import Limit, build, one_of
from imfvla.recording.pictures import MAX_PIXELS, decode
from imfvla.sources.checks import channels, documented, shortened
from imfvla.sources.ros2.bag import Received

JOINT_FIELDS = ("position", "velocity", "effort")
TOPIC = Limit("the name of a topic", bool)
_STEP = re.compile(r"([A-Za-z]\w*)(?:\[(\d{1,6})\])?")
# encoding of sensor_msgs/Image -> number of its channels, places of red, green and blue among them
COLOURS = {
    "rgb8": (3, (0, 1, 2)), "8UC3": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0)),
}  # fmt: skip
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True, slots=True)
class _Entry:
    """One entry of demos.state or demos.action."""

    topic: Annotated[str, TOPIC]
    channels: Any
    field: Annotated[str, one_of(*JOINT_FIELDS)] = "position"


@dataclass(frozen=True, slots=True)
class Part:
    """Channels that one topic has."""

    topic: str
    field: str
    keys: tuple[str | int, ...]  # names of joints, paths of fields, or places in an array
    names: tuple[str, ...]  # of the channels

    @classmethod
    def read(cls, values: Any, where: str) -> "Part":
        """From the options. Raises UserError naming the key."""
        entry = build(_Entry, values, where)
        if isinstance(entry.channels, Mapping):
            keys, names = tuple(map(str, entry.channels)), list(entry.channels.values())
        elif isinstance(entry.channels, list | tuple):
            keys, names = tuple(range(len(entry.channels))), list(entry.channels)
        else:
            keys, names = (), [None]
        if not all(isinstance(name, str) for name in names):
            raise UserError(
                f"{where}.channels must be a mapping of joints to names of channels, or a list of names, "
                f"found {shortened(entry.channels)}: {documented('ros2')}."
            )
        return cls(entry.topic, entry.field, keys, channels(names, f"{where}.channels", need_units=True))

    def values(self, message: Received) -> tuple[list[float] | None, int]:
        """The numbers of a message in the order of `names`, and its header.stamp [ns], 0 where it has none.

        None in place of the numbers where it has none of them: several nodes may publish on one topic, each its own
        joints. Raises UserError where only some are missing.
        """
        decoded = message.decode()
        found = self._found(decoded)
        missing = [key for key in self.keys if key not in found]
        if len(missing) == len(self.keys):
            return None, 0
        if missing or (self.keys[0] == 0 and len(found) != len(self.keys)):
            raise self.unfit(message)
        values = [float(found[key]) for key in self.keys]
        if not all(map(math.isfinite, values)):
            raise UserError(
                f"{message.file}: {self.topic} must be finite, found {shortened(values)}; leave this bag out."
            )
        return values, _stamp(decoded)

    def unfit(self, message: Received) -> UserError:
        """The error for a message that has other fields than these channels."""
        found = self._found(message.decode()) or _fields(message.decode())
        if self.keys[:1] == (0,):  # a list of channels takes an array in order
            is_array = hasattr(message.decode(), "data")
            remedy = "correct the list" if is_array else "write a mapping of joints or fields to channels"
            found = f"{len(found)} numbers" if is_array else shortened(", ".join(map(str, found)))
            return UserError(
                f"{message.file}: {message.kind} of {self.topic} must have an array of {len(self.keys)} numbers, as "
                f"many as the list has channels, found {found}; {remedy} in the options."
            )
        return UserError(
            f"{message.file}: {message.kind} of {self.topic} must have {self.field} "
            f"{shortened(', '.join(map(str, self.keys)))}, found {shortened(', '.join(map(str, found)))}; "
            "correct its channels in the options."
        )

    def _found(self, message: Any) -> Mapping[str | int, float]:
        if hasattr(message, "data") and self.keys[:1] == (0,):  # std_msgs/Float64MultiArray and the like
            return dict(enumerate(message.data)) if _is_list(message.data) else {}
        if hasattr(message, "name") and hasattr(message, self.field):  # sensor_msgs/JointState
            return dict(zip(message.name, getattr(message, self.field), strict=False))
        if hasattr(message, "joint_names") and hasattr(message, "points"):  # trajectory_msgs/JointTrajectory
            field = {"position": "positions", "velocity": "velocities"}.get(self.field, self.field)
            return (
                dict(zip(message.joint_names, getattr(message.points[0], field), strict=False))
                if message.points
                else {}
            )
        if hasattr(message, "joint_names") and hasattr(
            message, "interface_values"
        ):  # control_msgs/DynamicJointState
            pairs = zip(message.joint_names, message.interface_values, strict=False)
            joints = {
                name: dict(zip(part.interface_names, part.values, strict=False)) for name, part in pairs
            }
            return {name: part[self.field] for name, part in joints.items() if self.field in part}
        found = {key: _at(message, str(key)) for key in self.keys}
        return {key: value for key, value in found.items() if value is not None}


def _fields(message: Any) -> tuple[str, ...]:
    """Names of the fields that a message was recorded with."""
    return tuple(getattr(type(message), "__slots__", ())) if isinstance(message, SimpleNamespace) else ()


def _is_list(values: Any) -> bool:
    return isinstance(values, Sequence) and not isinstance(values, str | bytes)


def _at(message: Any, path: str) -> float | None:
    """The number at a path such as pose.position.x, None where there is none. Only recorded fields are reached."""
    for step in path.split("."):
        match = _STEP.fullmatch(step)
        if match is None or match.group(1) not in _fields(message):
            return None
        message = getattr(message, match.group(1))
        if match.group(2) is not None:
            place = int(match.group(2))
            if not _is_list(message) or place >= len(message):
                return None
            message = message[place]
    return message if isinstance(message, int | float) else None


def _stamp(message: Any) -> int:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec


def picture(message: Received) -> np.ndarray:
    """uint8 (H, W, 3) of an Image or a CompressedImage. Raises UserError where its kind or encoding is another."""
    if message.kind not in (IMAGE, COMPRESSED):
        raise UserError(
            f"{message.file}: {message.topic} must have sensor_msgs/msg/Image, CompressedImage or foxglove's "
            f"CompressedVideo (others are not supported), found {message.kind}; record or republish it as one of them."
        )
    decoded = message.decode()
    if message.kind == COMPRESSED:
        try:
            if "compressedDepth" in decoded.format:
                raise ValueError("depth, which is not supported")
            return decode(bytes(decoded.data))
        except ValueError as error:
            raise _bad(message, "a PNG or JPEG", str(error)) from error
    if decoded.encoding not in COLOURS:
        raise _bad(
            message, f"an encoding of {', '.join(COLOURS)} (others are not supported)", decoded.encoding
        )
    depth, places = COLOURS[decoded.encoding]
    height, width, step = decoded.height, decoded.width, decoded.step
    data = np.frombuffer(bytes(decoded.data), np.uint8)
    if not 0 < height * width <= MAX_PIXELS or step < width * depth or len(data) < height * step:
        raise _bad(
            message, "as many bytes as its size says", f"{height} x {width}, step {step}, {len(data)} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * depth]
    return np.ascontiguousarray(rows.reshape(height, width, depth)[..., places])


def _bad(message: Received, wanted: str, found: str) -> UserError:
    return UserError(
        f"{message.file}: a picture of {message.topic} must be {wanted}, found {shortened(found)}; "
        "choose another topic, or record the bag again."
    )
