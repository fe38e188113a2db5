"""The environment that a config describes, and what is usually seen of it: the one place where one is chosen."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from imfvla.config.construction import construct
from imfvla.config.views import ViewOptions, view_options
from imfvla.environment import Environment
from imfvla.errors import UserError
from imfvla.options import part_of

KIND = "task.kind"
BIMANUAL, GYMNASIUM = "bimanual", "gymnasium"
NO_ENVIRONMENT = "none"  # as task.name: the run trains on data and is judged on data
KINDS = (BIMANUAL, GYMNASIUM)
COMPONENT = "component"  # a class that another package registers: task._target_
SHARED = ("kind", "name", "paraphrases", "robot")  # keys of `task` that such a class is not given


def environment_of(config: Mapping[str, Any]) -> Environment:
    """Builds the environment of a composed config, or of a run directory's: what `task` and `observation` say.

    `task.kind` says whose it is; without one, it is a task of this package. `task._target_` is a class that another
    package registers; it is given the other keys of `task`, and those of name, views and image_size that its
    constructor takes. Raises UserError where a key is missing or wrong, and where the package that simulates is not
    installed.
    """
    task = part_of(config, "task")
    if kind_of(task) == COMPONENT:
        shown = seen_in(config)
        views = {} if shown.views is None else {"views": shown.views}
        return construct(
            {key: value for key, value in task.items() if key not in SHARED},
            "task",
            Environment,
            name=part_of(config, "task.name"),
            image_size=shown.image_size,
            **views,
        )
    if kind_of(task) == GYMNASIUM:
        from imfvla.gymnasium_env import load  # here, since it needs an extra

        return load(task, part_of(config, "observation"))
    from imfvla import tasks  # here, since few configs are of these tasks' robot

    shown = seen_in(config)
    return tasks.load(
        part_of(config, "task.name"),
        variant=part_of(config, "task.variant"),
        views=shown.views,
        image_size=shown.image_size,
    )


def usual_views(task: Mapping[str, Any]) -> list[str] | None:
    """The cameras that a policy sees unless `observation.views` names others.

    All that `task.robot` has, or those that our own tasks choose; None where only environment or data can tell.
    """
    robot = task.get("robot")
    if robot is not None:
        cameras = robot.get("cameras") if isinstance(robot, Mapping) else None
        listed = [camera for camera in cameras or () if isinstance(camera, Mapping)]
        # Whatever is wrong with them is reported where the robot is read.
        return [camera["name"] for camera in listed if isinstance(camera.get("name"), str)] or None
    if "_target_" in task or task.get("kind", BIMANUAL) != BIMANUAL or task.get("name") == NO_ENVIRONMENT:
        return None
    from imfvla.tasks.bimanual_robot import USUAL_VIEWS

    return list(USUAL_VIEWS)


def seen_in(config: Mapping[str, Any]) -> ViewOptions:
    """`observation` of a config, with the usual cameras of its task where it names none."""
    shown, views = view_options(config), None
    if shown.views is None and (views := usual_views(part_of(config, "task"))) is not None:
        return replace(shown, views=tuple(views))
    return shown


def kind_of(task: Mapping[str, Any]) -> str:
    """One of KINDS, or COMPONENT where there is a `_target_`. Raises UserError for any other."""
    if "_target_" in task:
        return COMPONENT
    kind = task.get("kind", BIMANUAL)
    if kind not in KINDS:
        raise UserError(f"{KIND} must be one of {', '.join(KINDS)}, found {kind!r}: choose another task=...")
    return kind
