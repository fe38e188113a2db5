"""The environment that a config describes: the one place where an environment is chosen."""

from collections.abc import Mapping
from typing import Any

from imfvla.environment import Environment
from imfvla.errors import UserError
from imfvla.options import build, part_of
from imfvla.views import ViewOptions

KIND = "task.kind"
BIMANUAL, GYMNASIUM = "bimanual", "gymnasium"
KINDS = (BIMANUAL, GYMNASIUM)


def environment_of(config: Mapping[str, Any]) -> Environment:
    """Builds the environment of a composed config, or of a run directory's: what `task` and `observation` say.

    `task.kind` says whose it is; without one, it is a task of this package. Raises UserError where a key is missing or
    wrong, and where the package that simulates is not installed.
    """
    task = part_of(config, "task")
    if kind_of(task) == GYMNASIUM:
        from imfvla.gymnasium_env import load  # here, since it needs an extra

        return load(task, part_of(config, "observation"))
    from imfvla import tasks  # here, since few configs are of these tasks' robot

    seen = {key: part_of(config, f"observation.{key}") for key in ViewOptions.__slots__}
    shown = build(ViewOptions, seen, "observation")
    return tasks.load(
        part_of(config, "task.name"),
        variant=part_of(config, "task.variant"),
        views=shown.views,
        image_size=shown.image_size,
    )


def kind_of(task: Mapping[str, Any]) -> str:
    """One of KINDS. Raises UserError for any other."""
    kind = task.get("kind", BIMANUAL)
    if kind not in KINDS:
        raise UserError(f"{KIND} must be one of {', '.join(KINDS)}, found {kind!r}: choose another task=...")
    return kind
