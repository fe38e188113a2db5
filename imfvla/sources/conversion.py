"""Episodes of one format written in another, all or none."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Protocol

from imfvla.errors import UserError
from imfvla.options import Limit, build, one_of
from imfvla.process.progress import Progress
from imfvla.robot import RobotSpec
from imfvla.sources import EpisodeArrays
from imfvla.sources.opening import KINDS, SCRIPTED, SHARED

READERS = tuple(kind for kind in KINDS if kind != SCRIPTED)
PATH = Limit("a path", bool)


class Writer(Protocol):
    """Takes the episodes of a new data set one after the other."""

    def add(self, episode: EpisodeArrays) -> None: ...


@dataclass(frozen=True, slots=True)
class _ToMcap:
    """conf/to/mcap.yaml."""

    format: str
    path: Annotated[str, PATH]

    def writer(self, robot: RobotSpec) -> AbstractContextManager[Writer]:
        from imfvla.sources.mcap_writer import McapWriter

        return McapWriter(self.path, robot)


@dataclass(frozen=True, slots=True)
class _ToLeRobot:
    """conf/to/lerobot.yaml."""

    format: str
    path: Annotated[str, PATH]
    pictures: Annotated[str, one_of("av1", "h264", "png")]

    def writer(self, robot: RobotSpec) -> AbstractContextManager[Writer]:
        from imfvla.sources.lerobot import LeRobotWriter  # needs an extra

        return LeRobotWriter(self.path, robot, pictures=self.pictures)


TARGETS = {"lerobot": _ToLeRobot, "mcap": _ToMcap}


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written."""

    path: Path
    num_episodes: int
    num_steps: int
    num_repeats: int  # steps whose picture is that of a step before


def convert(source: Mapping[str, Any], target: Mapping[str, Any]) -> Converted:
    """Writes all episodes of `source`, options as in conf/demos, to `target`, options as in conf/to.

    Raises UserError naming file or key; then nothing was written.
    """
    to = _target(target)
    kind = source.get("source")
    if kind not in READERS:
        raise UserError(f"from.source must be one of {', '.join(READERS)}, found {kind!r}: choose from=....")
    if source.get("frames_directory") is not None:
        raise UserError("from.frames_directory is for training alone: drop it.")
    options = {key: value for key, value in source.items() if key not in SHARED}
    episodes = import_module(f"imfvla.sources.{kind}").open_source(options, where="from")
    views = [camera.name for camera in episodes.robot.cameras]
    num_steps = 0
    with to.writer(episodes.robot) as writer, Progress(f"{kind} to {to.format}", len(episodes)) as bar:
        for index in range(len(episodes)):
            episode = episodes.episode(index, views)
            writer.add(episode)
            num_steps += len(episode.state)
            bar.advance(episode.name)
    return Converted(Path(to.path), len(episodes), num_steps, getattr(writer, "num_repeats", 0))


def _target(options: Mapping[str, Any]) -> _ToMcap | _ToLeRobot:
    chosen = options.get("format") if isinstance(options, Mapping) else None
    if chosen not in TARGETS:
        raise UserError(f"to.format must be one of {', '.join(TARGETS)}, found {chosen!r}: choose to=....")
    return build(TARGETS[chosen], options, "to")
