"""The options of a source of ROS 2 bags, as conf/demos/ros2.yaml documents them, and the checks of their parts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.errors import UserError
from imfvla.options import above, at_least, one_of, within
from imfvla.robot import MAX_CONTROL_HZ
from imfvla.sources.checks import SENTENCE, documented, shortened
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
    cameras: Mapping[str, str]  # view -> topic
    absolute: tuple[str, ...] | None
    action_min: tuple[float, ...] | None
    action_max: tuple[float, ...] | None
    camera_every: Annotated[int, at_least(1)]
    instruction: Annotated[str, SENTENCE] | None
    instruction_topic: str | None
    marks: Marks | None
    clock: Annotated[str, one_of("stamp", "log")]
    max_gap_s: Annotated[float, above(0)]
    max_skew_s: Annotated[float, above(0)]


def read_parts(entries: Any, key: str) -> tuple[Part, ...]:
    """The entries of demos.state or demos.action. Raises UserError naming `key`."""
    if not isinstance(entries, list | tuple) or not entries:
        raise UserError(
            f"{key} must be a list of entries with topic and channels, found {shortened(entries)}: "
            f"{documented('ros2')}."
        )
    return tuple(Part.read(entry, f"{key}[{number}]") for number, entry in enumerate(entries))


def read_paths(path: Any, where: str) -> list[str]:
    """One path or several. Raises UserError where it is neither, or none."""
    paths = [path] if isinstance(path, str | Path) else path
    fits = isinstance(paths, list | tuple) and all(isinstance(one, str | Path) and str(one) for one in paths)
    if not fits or not paths:
        raise UserError(f"{where}.path must be a path or a list of paths, found {shortened(path)}.")
    return list(map(str, paths))
