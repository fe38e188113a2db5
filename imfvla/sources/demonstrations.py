"""What is demonstrated: the task and the expert of a folder of recordings, and what the folder's content depends on."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from imfvla import tasks
from imfvla.environment import Environment
from imfvla.environments import BIMANUAL, GYMNASIUM, KIND, environment_of, kind_of, seen_in
from imfvla.episode import Actor
from imfvla.errors import UserError
from imfvla.options import build, part_of, require
from imfvla.storage.run_directory import flatten


class Settings(Protocol):
    """What the content of a folder of demonstrations depends on beside the seeds. Hashable, sent to the workers."""

    task: str
    views: tuple[str, ...]
    camera_every: int

    @property
    def folder(self) -> str:
        """The name of the folder."""
        ...

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """(H, W) [px] of the views."""
        ...

    def to_json(self) -> dict[str, Any]: ...

    def build(self) -> tuple[Environment, Actor]:
        """The environment, and who demonstrates in it. Raises UserError where either cannot be."""
        ...


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Which of this package's own tasks is demonstrated; see `imfvla.tasks.load`."""

    name: str
    variant: str


@dataclass(frozen=True, slots=True)
class ExpertOptions:
    """How the expert demonstrates; see `imfvla.tasks.experts.Expert`."""

    modes: int
    noise: float
    hold: int
    dwell: int
    recoveries: float = 0  # older than runs without it
    max_turn: float | None = None  # the same


@dataclass(frozen=True, slots=True)
class BimanualSettings:
    """Of this package's own tasks."""

    task: str
    variant: str
    modes: int
    noise: float
    hold: int
    dwell: int
    recoveries: float
    max_turn: float | None
    views: tuple[str, ...]
    image_size: tuple[int, int]
    camera_every: int

    @property
    def folder(self) -> str:
        height, width = self.image_size
        waiting = f"-dwell{self.dwell}" if self.dwell else ""
        missing = f"-recoveries{self.recoveries:g}" if self.recoveries else ""
        smooth = f"-turn{self.max_turn:g}" if self.max_turn is not None else ""
        return f"{self.task}-{self.variant}-modes{self.modes}{waiting}{missing}{smooth}-{height}x{width}"

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        return (self.image_size,) * len(self.views)

    def to_json(self) -> dict[str, Any]:
        """Without what is newer and not asked for: such recordings have the bytes that they had before."""
        return {
            key: value
            for key, value in asdict(self).items()
            if key not in ("recoveries", "max_turn") or value not in (0, None)
        }

    def build(self) -> tuple[Environment, Actor]:
        from imfvla.tasks.experts import make_expert  # here, since it imports the simulator

        env = environment_of(
            {
                "task": {"name": self.task, "variant": self.variant},
                "observation": {"views": self.views, "image_size": self.image_size},
            }
        )
        return env, make_expert(
            self.task,
            modes=self.modes,
            noise=self.noise,
            hold=self.hold,
            dwell=self.dwell,
            recoveries=self.recoveries,
            max_turn=self.max_turn,
        )


@dataclass(frozen=True, slots=True)
class GymnasiumSettings:
    """Of a Gymnasium environment that an expert is known for. definition: the config groups, as JSON."""

    task: str
    views: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    camera_every: int
    definition: str

    @property
    def folder(self) -> str:
        return "-".join([self.task, *dict.fromkeys(f"{height}x{width}" for height, width in self.sizes)])

    def to_json(self) -> dict[str, Any]:
        return {"camera_every": self.camera_every, **flatten(json.loads(self.definition))}

    def build(self) -> tuple[Environment, Actor]:
        from imfvla.gymnasium_env.experts import make_expert  # here, since it needs an extra

        definition = json.loads(self.definition)
        env = environment_of(definition)
        return env, make_expert(definition["task"])


def settings_of(
    task: Mapping[str, Any], observation: Mapping[str, Any], camera_every: int, where: str
) -> Settings:
    """The checked settings of a collection; `where` is the key of `camera_every`. Raises UserError."""
    shown = seen_in({"task": task, "observation": observation})
    if kind_of(task) == GYMNASIUM:
        return _gymnasium_settings(task, asdict(shown), camera_every, where)
    if kind_of(task) != BIMANUAL:
        raise UserError(
            f"{KIND}={kind_of(task)} has no scripted expert, and so no demonstrations to collect: name recordings or a "
            "data set with another demos=..."
        )
    _require_frames(camera_every, tasks.TIME_LIMIT_STEPS, where)
    expert = build(ExpertOptions, part_of({"task": task}, "task.expert"), "task.expert")
    scene = build(
        SceneOptions, {key: part_of({"task": task}, f"task.{key}") for key in ("name", "variant")}, "task"
    )
    return BimanualSettings(
        task=scene.name, variant=scene.variant, **asdict(expert), **asdict(shown), camera_every=camera_every
    )


def _gymnasium_settings(
    task: Mapping[str, Any], seen: Mapping[str, Any], camera_every: int, where: str
) -> GymnasiumSettings:
    from imfvla.gymnasium_env.options import read_task

    read = read_task(task, seen)
    if task.get("expert") is None:
        raise UserError(
            f"task.expert is null: {read.name} has no scripted expert, and so no demonstrations to collect; name "
            "recordings or a data set with another demos=..."
        )
    _require_frames(camera_every, read.time_limit_steps, where)
    cameras = [read.robot.camera(view) for view in read.views]
    return GymnasiumSettings(
        task=read.name,
        views=read.views,
        sizes=tuple((camera.height, camera.width) for camera in cameras),
        camera_every=camera_every,
        # Whether a training draws among its sentences changes no recording.
        definition=json.dumps({"task": {**task, "paraphrases": False}, "observation": seen}),
    )


def _require_frames(camera_every: int, most: int, where: str) -> None:
    require(camera_every <= most, where, f"between 1 and {most}, the steps of an episode", camera_every)
