"""Which episodes of a source are kept from training, to judge a policy on where there is no environment."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from imfvla.errors import UserError
from imfvla.options import above, build


@dataclass(frozen=True, slots=True)
class NoEnvironment:
    """conf/task/none.yaml."""

    name: str
    paraphrases: bool
    held_out: Annotated[int | float, above(0)]  # below 1 a share of the episodes, else their number


def held_out(task: Mapping[str, Any], num_episodes: int) -> tuple[int, ...]:
    """The numbers of the episodes that the `task` of a config keeps from training, spread evenly.

    Raises UserError where none would be left to train on, or none to judge on.
    """
    if "held_out" not in task:
        return ()
    wanted = build(
        NoEnvironment, {key: task[key] for key in NoEnvironment.__slots__ if key in task}, "task"
    ).held_out
    count = round(wanted * num_episodes) if wanted < 1 else int(wanted)
    if not 0 < count < num_episodes:
        raise UserError(
            f"task.held_out must leave at least one of the {num_episodes} episodes to train on and one to judge on, "
            f"found {wanted:g}: choose a share such as 0.1 or a smaller number, or use more episodes."
        )
    places = (np.arange(count) + 0.5) * num_episodes / count
    return tuple(places.astype(int).tolist())
