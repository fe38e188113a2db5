"""RoboIMI's two bimanual tasks in dm_control, both in one scene, and two tasks on which averages fail.

Importing this package has the GL backend picked before mujoco is imported, and does nothing else. Names, limits and the
robot need no simulator; `load` imports it.
"""

from typing import TYPE_CHECKING

from imfvla.errors import UserError
from imfvla.process.gl import select_before_simulators
from imfvla.tasks.bimanual_robot import ALL_VIEWS, TIME_LIMIT_STEPS, bimanual_robot
from imfvla.tasks.catalogue import NAMES, class_at, entry_of, text_for

if TYPE_CHECKING:
    from imfvla.tasks.bimanual_environment import BimanualEnvironment

select_before_simulators()

VARIANTS = ("easy", "default", "hard")
VIEWS = ("front", "top", "r_wrist")

__all__ = [
    "ALL_VIEWS",
    "NAMES",
    "TIME_LIMIT_STEPS",
    "VARIANTS",
    "VIEWS",
    "bimanual_robot",
    "load",
    "text_for",
]


def load(
    name: str,
    *,
    variant: str = "default",
    image_size: tuple[int, int] = (96, 96),
    views: tuple[str, ...] = VIEWS,
) -> "BimanualEnvironment":
    """Builds the task `name`, one of `NAMES`; "combined" has the objects of two and one sentence an episode.

    Args:
        variant: how far start states spread and how tight the fit is: "easy", "default" or "hard".
        image_size: (height, width) [px] of the pictures that `look` returns.
        views: cameras that `look` renders.

    Raises:
        UserError: unknown task, variant or view.
    """
    entry = entry_of(name)
    if variant not in VARIANTS:
        raise UserError(f"task.variant must be one of {', '.join(VARIANTS)}, found {variant!r}.")
    # mujoco is imported here, only by code that simulates.
    from imfvla.tasks.bimanual_environment import BimanualEnvironment

    return BimanualEnvironment(class_at(entry.task)(variant), image_size=image_size, views=views)
