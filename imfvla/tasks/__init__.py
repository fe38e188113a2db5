"""RoboIMI's two bimanual tasks in dm_control, both in one scene, and two tasks on which averages fail.

Importing this package picks the GL backend and does nothing else.
"""

from typing import TYPE_CHECKING

from imfvla.errors import UserError
from imfvla.gl import select_gl_backend
from imfvla.tasks.texts import TEXTS, text_for

if TYPE_CHECKING:
    from imfvla.tasks.bimanual import BimanualEnvironment

select_gl_backend()  # before anything imports mujoco

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
    """Builds the task `name`, one of NAMES. "combined" has the objects of socket and transfer.

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
    # mujoco is imported here: after the backend is chosen, and only by code that simulates.
    from imfvla.tasks.bimanual import BimanualEnvironment
    from imfvla.tasks.combined import CombinedTask
    from imfvla.tasks.either_arm import EitherArmTask
    from imfvla.tasks.gate import GateTask
    from imfvla.tasks.socket import SocketTask
    from imfvla.tasks.transfer import TransferTask

    made = {
        "socket": SocketTask,
        "transfer": TransferTask,
        "combined": CombinedTask,
        "either_arm": EitherArmTask,
        "gate": GateTask,
    }
    return BimanualEnvironment(made[name](variant), seed=seed, image_size=image_size, views=views)
