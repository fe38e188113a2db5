"""RoboIMI's two bimanual tasks in dm_control, and both in one scene.

Importing this package has the GL backend picked before mujoco is imported, and does nothing else.
"""

from typing import TYPE_CHECKING

from imfvla.errors import UserError
from imfvla.gl import select_before_simulators
from imfvla.tasks.texts import TEXTS, text_for

if TYPE_CHECKING:
    from imfvla.tasks.bimanual import BimanualEnvironment

select_before_simulators()

NAMES = (*TEXTS, "combined")
VARIANTS = ("easy", "default", "hard")
VIEWS = ("front", "top", "r_wrist")

__all__ = ["NAMES", "VARIANTS", "VIEWS", "load", "text_for"]


def load(
    name: str,
    *,
    seed: int | None = None,
    variant: str = "default",
    image_size: tuple[int, int] = (96, 96),
    views: tuple[str, ...] = VIEWS,
) -> "BimanualEnvironment":
    """Builds the task `name`: "socket", "transfer", or "combined": the objects of both and one sentence an episode.

    Args:
        seed: drawn from by `reset()` without a seed of its own.
        variant: how far start states spread and how tight the fit is: "easy", "default" or "hard".
        image_size: (height, width) [px] of the pictures that `look` returns.
        views: cameras that `look` renders when none are named.

    Raises:
        UserError: unknown task, variant or view.
    """
    if name not in NAMES:
        raise UserError(f"There is no task {name!r}; choose one of {', '.join(sorted(NAMES))}.")
    if variant not in VARIANTS:
        raise UserError(f"task.variant must be one of {', '.join(VARIANTS)}, found {variant!r}.")
    # mujoco is imported here, only by code that simulates.
    from imfvla.tasks.bimanual import BimanualEnvironment
    from imfvla.tasks.combined import CombinedTask
    from imfvla.tasks.socket import SocketTask
    from imfvla.tasks.transfer import TransferTask

    task = {"socket": SocketTask, "transfer": TransferTask, "combined": CombinedTask}[name](variant)
    return BimanualEnvironment(task, seed=seed, image_size=image_size, views=views)
