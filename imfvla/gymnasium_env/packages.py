"""Which packages may be imported to register their environments, and what is known of two of them.

A config that comes with a run directory or a checkpoint must not import whatever it names. Allowed are the packages of
`ADAPTERS` and those that are installed with an entry point in one of `GROUPS`.
"""

from collections.abc import Callable
from importlib import import_module, metadata
from typing import Any, Protocol

import numpy as np

from imfvla.config.assets import install_command
from imfvla.errors import UserError

GROUPS = ("imfvla.components", "gymnasium.envs")
INSTALL_PUSHT = "pip install --no-deps gym-pusht==0.1.8"  # the extra has what else it needs
# module -> the module here that adapts its environments
ADAPTERS = {"gym_aloha": "imfvla.gymnasium_env.aloha", "gym_pusht": "imfvla.gymnasium_env.pusht"}


class Cameras(Protocol):
    """Draws an environment's pictures when asked, and not in every step."""

    names: tuple[str, ...]

    def draw(self, name: str, height: int, width: int) -> np.ndarray:
        """uint8 (height, width, 3)."""
        ...

    def start(self) -> np.ndarray:
        """The simulator's state (n,), which observations need not show."""
        ...

    def renderer(self) -> str: ...

    def close(self) -> None: ...


def import_gymnasium() -> Any:
    """The package gymnasium. UserError naming the extra where it is not installed."""
    try:
        return import_module("gymnasium")
    except ModuleNotFoundError as error:
        raise UserError(
            f"task.kind=gymnasium needs the package gymnasium: run `{install_command('gym')}`."
        ) from error


def register(package: str | None) -> None:
    """Imports `package`, so that its environments are registered. None: they are, as Gymnasium's own are.

    Raises UserError where it is not allowed or not installed.
    """
    if package is None:
        return
    allowed = allowed_packages()
    if package not in allowed:
        raise UserError(
            f"task.package must be null or one of {', '.join(sorted(allowed))}, found {package!r}: nothing else is "
            f"imported for a config; install a package that has an entry point in the group {GROUPS[0]}."
        )
    try:
        import_module(package)
    except ImportError as error:
        raise UserError(
            f"task.package={package} cannot be imported ({error}): run `{install_command('gym')}`, for gym_pusht also "
            f"`{INSTALL_PUSHT}`."
        ) from error


def allowed_packages() -> set[str]:
    """The modules that `register` imports."""
    points = [point for group in GROUPS for point in metadata.entry_points(group=group)]
    return {*ADAPTERS, *(point.value.split(":")[0].split(".")[0] for point in points)}


def cameras_of(package: str | None, env: Any) -> Cameras | None:
    """Takes over the drawing of an environment whose package is known here; None for others."""
    if package not in ADAPTERS:
        return None
    adapt: Callable[[Any], Cameras] = import_module(ADAPTERS[package]).adapt
    return adapt(env)


def version_of(package: str | None) -> str:
    """The package and its version, such as "gym_aloha 0.1.3"."""
    name = package or "gymnasium"
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:  # a distribution of another name
        return name
