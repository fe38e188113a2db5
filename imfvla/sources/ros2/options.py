"""The options of a source of ROS 2 bags, as conf/demos/ros2.yaml documents them, and the checks of their parts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.errors import UserError
from imfvla.options import above, at_least, one_of, within
from imfvla.robot import MAX_CONTROL_HZ
from imfvla.sources.checks import shortened
from imfvla.sources.ros2.fields import Part


@dataclass(frozen=True, slots=True)
class Marks:
    """Texts of a topic between which episodes lie."""

    topic: str
    start: str
    stop: str


@dataclass(frozen=True, slots=True)
class Options:
    """What conf/demos/ros2.yaml documents."""

    path: Any  # a path or a list of paths
    episodes: tuple[Annotated[int, at_least(0)], ...] | None
    control_hz: Annotated[float, above(0), within(0, MAX_CONTROL_HZ)]
    state: Any  # entries of `Part`
    action: Any  # the same, or null
    cameras: Any  # view -> topic
    absolute: tuple[str, ...] | None
    action_min: tuple[float, ...] | None
    action_max: tuple[float, ...] | None
    camera_every: Annotated[int, at_least(1)]
    instruction: str | None
    instruction_topic: str | None
    marks: Any  # of `Marks`, or null
    clock: Annotated[str, one_of("stamp", "log")]
    max_gap_s: Annotated[float, above(0)]
    max_skew_s: Annotated[float, above(0)]


def read_parts(entries: Any, key: str) -> tuple[Part, ...]:
    """The entries of demos.state or demos.action. Raises UserError naming `key`."""
    if not isinstance(entries, list | tuple) or not entries:
        raise UserError(
            f"{key} must be a list of entries with topic and channels, found {shortened(entries)}: "
            "see conf/demos/ros2.yaml."
        )
    return tuple(Part.read(entry, f"{key}[{number}]") for number, entry in enumerate(entries))


def read_cameras(views: Any, where: str) -> dict[str, str]:
    """View -> topic. Raises UserError where it is no such mapping."""
    fits = isinstance(views, Mapping) and all(isinstance(topic, str) for topic in views.values())
    if not fits:
        raise UserError(f"{where}.cameras must be a mapping of views to topics, found {shortened(views)}.")
    return {str(view): topic for view, topic in views.items()}


def read_paths(path: Any, where: str) -> list[str]:
    """One path or several. Raises UserError where it is neither."""
    paths = [path] if isinstance(path, str | Path) else path
    if not isinstance(paths, list | tuple) or not all(
        isinstance(one, str | Path) and str(one) for one in paths
    ):
        raise UserError(f"{where}.path must be a path or a list of paths, found {shortened(path)}.")
    return list(map(str, paths))
