"""The keys of a Gymnasium task's YAML, checked. Needs numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from imfvla.config.views import ViewOptions
from imfvla.errors import UserError
from imfvla.options import Limit, at_least, build, convert, require
from imfvla.robot import RobotSpec

REWARD, RENDER = "reward", "render"
OBSERVATION, INFO, CAMERA = "observation", "info", "camera"  # before a slash
NOT_EMPTY = Limit("a text that is not empty", bool)
# Arguments of gymnasium.make itself, and the one that this package sets.
TAKEN = (
    "id", "max_episode_steps", "disable_env_checker", "vectorization_mode", "vector_kwargs", "wrappers", "render_mode",
)  # fmt: skip
MAX_STEPS = 1_000_000


@dataclass(frozen=True, slots=True)
class Threshold:
    """Holds where a number of a step reaches a value: `of` is "reward", or a place such as "info/is_success"."""

    of: str
    at_least: float


@dataclass(frozen=True, slots=True)
class _Keys:
    """The keys as the YAML has them; what `conf/task/gymnasium.yaml` says of each is not repeated here."""

    kind: str
    name: Annotated[str, NOT_EMPTY]
    id: Annotated[str, NOT_EMPTY]
    package: str | None
    kwargs: Any
    state: tuple[str, ...]
    pictures: Any
    success: Any
    stages: Any
    time_limit_steps: Annotated[int, at_least(1)]
    instruction: Annotated[str, NOT_EMPTY]
    sentences: tuple[str, ...]
    paraphrases: bool
    robot: Any
    variant: str = "default"
    expert: Any = None


@dataclass(frozen=True, slots=True)
class GymnasiumTask:
    """A Gymnasium environment as a config describes it.

    state: places of the numbers that make up the state, in order. pictures: camera -> where its picture comes from.
    stages: name -> the least reward at which it holds, ascending.
    """

    name: str
    id: str
    package: str | None
    kwargs: Mapping[str, Any]
    state: tuple[str, ...]
    pictures: Mapping[str, str]
    success: Threshold
    stages: Mapping[str, float]
    time_limit_steps: int
    instruction: str
    sentences: tuple[str, ...]
    robot: RobotSpec
    views: tuple[str, ...]


def read_task(task: Mapping[str, Any], observation: Mapping[str, Any]) -> GymnasiumTask:
    """The checked keys of `task` and of `observation`. Raises UserError naming the key, the wanted and the found."""
    keys = build(_Keys, task, "task")
    require(
        keys.time_limit_steps <= MAX_STEPS,
        "task.time_limit_steps",
        f"1 to {MAX_STEPS}",
        keys.time_limit_steps,
    )
    if ":" in keys.id:  # gymnasium.make would import the module before the colon
        raise UserError(
            f"task.id must name an environment without a module, such as CartPole-v1, found {keys.id!r}: name its "
            "package in task.package."
        )
    robot = RobotSpec.from_json(keys.robot, "task.robot")
    seen = {key: observation.get(key) for key in ViewOptions.__slots__ if key in observation}
    views = build(ViewOptions, seen, "observation").views or tuple(camera.name for camera in robot.cameras)
    pictures = _texts(keys.pictures, "task.pictures")
    for view in views:
        robot.camera(view)
        require(view in pictures, f"task.pictures.{view}", "where its picture comes from", None)
        _check_source(pictures[view], f"task.pictures.{view}")
    require(bool(keys.state), "task.state", "one or more places such as observation/agent_pos", keys.state)
    for number, place in enumerate(keys.state):
        _check_place(place, f"task.state[{number}]")
    success = build(Threshold, _mapping(keys.success, "task.success"), "task.success")
    if success.of != REWARD:
        _check_place(success.of, "task.success.of", f"{REWARD}, or ")
    kwargs = _mapping(keys.kwargs, "task.kwargs")
    for key in kwargs:
        require(key not in TAKEN, "task.kwargs", f"without {key}, which imfvla sets", key)
    return GymnasiumTask(
        name=keys.name,
        id=keys.id,
        package=keys.package,
        kwargs=kwargs,
        state=keys.state,
        pictures=pictures,
        success=success,
        stages=_stages(keys.stages),
        time_limit_steps=keys.time_limit_steps,
        instruction=keys.instruction,
        sentences=keys.sentences,
        robot=robot,
        views=views,
    )


def _stages(values: Any) -> dict[str, float]:
    stages = {
        name: convert(value, float, f"task.stages.{name}")
        for name, value in _mapping(values, "task.stages").items()
    }
    rewards = list(stages.values())
    require(len(set(rewards)) == len(rewards), "task.stages", "rewards that all differ", rewards)
    return dict(sorted(stages.items(), key=lambda stage: stage[1]))


def _texts(values: Any, key: str) -> dict[str, str]:
    return {name: convert(value, str, f"{key}.{name}") for name, value in _mapping(values, key).items()}


def _mapping(values: Any, key: str) -> dict[str, Any]:
    require(values is None or isinstance(values, Mapping), key, "a mapping of keys to values", values)
    return {str(name): value for name, value in (values or {}).items()}


def _check_source(source: str, key: str) -> None:
    if source != RENDER and source.split("/")[0] != CAMERA:
        _check_place(source, key, f"{RENDER}, {CAMERA}/NAME, or ")


def _check_place(place: str, key: str, others: str = "") -> None:
    wanted = f"{others}a place below {OBSERVATION} or {INFO}, such as info/is_success"
    require(place.split("/")[0] in (OBSERVATION, INFO), key, wanted, place)
