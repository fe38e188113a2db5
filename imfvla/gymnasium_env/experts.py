"""Which expert demonstrates a Gymnasium task."""

from collections.abc import Mapping
from typing import Any

from imfvla.episode import Actor
from imfvla.errors import UserError


def make_expert(task: Mapping[str, Any]) -> Actor:
    """The expert of the config group `task`. Raises UserError where none is known."""
    if task["package"] != "gym_aloha":
        raise UserError(
            f"task.expert must be null, found {task['expert']!r}: this package has experts for gym_aloha's tasks only."
        )
    from imfvla.gymnasium_env.aloha_expert import AlohaExpert  # here, since it is an extra's

    return AlohaExpert(task["id"], task["expert"])
