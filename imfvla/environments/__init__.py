"""The environment that a config describes: the one place where an environment is chosen."""

from collections.abc import Mapping
from typing import Any

from imfvla.config.construction import construct
from imfvla.config.views import view_options
from imfvla.environment import Environment
from imfvla.errors import UserError
from imfvla.options import part_of

KIND = "task.kind"
BIMANUAL, GYMNASIUM = "bimanual", "gymnasium"
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
        shown = view_options(config)
        return construct(
            {key: value for key, value in task.items() if key not in SHARED},
            "task",
            Environment,
            name=part_of(config, "task.name"),
            views=shown.views,
            image_size=shown.image_size,
        )
    if kind_of(task) == GYMNASIUM:
        from imfvla.gymnasium_env import load  # here, since it needs an extra

        return load(task, part_of(config, "observation"))
    from imfvla import tasks  # here, since few configs are of these tasks' robot

    shown = view_options(config)
    return tasks.load(
        part_of(config, "task.name"),
        variant=part_of(config, "task.variant"),
        views=shown.views,
        image_size=shown.image_size,
    )


def kind_of(task: Mapping[str, Any]) -> str:
    """One of KINDS, or COMPONENT where there is a `_target_`. Raises UserError for any other."""
    if "_target_" in task:
        return COMPONENT
    kind = task.get("kind", BIMANUAL)
    if kind not in KINDS:
        raise UserError(f"{KIND} must be one of {', '.join(KINDS)}, found {kind!r}: choose another task=...")
    return kind
