"""Which packages may be imported to register their environments, and what is known of two of them.

A config that comes with a run directory or a checkpoint must not import whatever it names. Allowed are the packages of
`ADAPTERS` and those that are installed with an entry point in one of `GROUPS`. Gymnasium 1 loads no entry points, so
those of `GYMNASIUM` are loaded here.
"""

import inspect
from collections.abc import Callable
from functools import cache
from importlib import import_module, metadata
from typing import Any, Protocol

import numpy as np

from imfvla.config.assets import install_command
from imfvla.errors import UserError

GYMNASIUM = "gymnasium.envs"  # its entry points are functions that register environments, or modules that do
GROUPS = ("imfvla.components", GYMNASIUM)
MAX_REASON = 200  # characters of what a package's code says
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


def register(package: str | None, environment: str) -> None:
    """Lets `package` register its environments: imports it, and calls the functions of its entry points.

    None: Gymnasium's own are registered; where `environment` is none of them, all installed packages with an entry
    point in `GYMNASIUM` register theirs. Raises UserError where a package is not allowed, not installed or fails.
    """
    if package is None:
        if environment not in import_gymnasium().registry:
            for point in metadata.entry_points(group=GYMNASIUM):
                _call(point)
        return
    allowed = allowed_packages()
    if package not in allowed:
        raise UserError(
            f"task.package must be null or one of {', '.join(sorted(allowed))}, found {package!r}: nothing else is "
            f"imported for a config; install a package that has an entry point in the group {GYMNASIUM}."
        )
    try:
        import_module(package)
    except Exception as error:  # whatever the package does while it is imported
        remedy = "install it again, or correct it"
        if package in ADAPTERS:
            remedy = f"run `{install_command('gym')}`, for gym_pusht also `{INSTALL_PUSHT}`"
        raise UserError(f"task.package={package} cannot be imported ({_reason(error)}): {remedy}.") from error
    for point in metadata.entry_points(group=GYMNASIUM):
        if _package_of(point) == package:
            _call(point)


def allowed_packages() -> set[str]:
    """The modules that `register` imports."""
    return {
        *ADAPTERS,
        *(_package_of(point) for group in GROUPS for point in metadata.entry_points(group=group)),
    }


def registered_by(package: str) -> list[str]:
    """The ids of the environments whose code is in `package`, of those that are registered by now."""
    registry = import_gymnasium().registry
    return sorted(spec.id for spec in registry.values() if _module_of(spec.entry_point) == package)


def _module_of(code: Any) -> str:
    """Of "package.module:Class" or of a class: the outermost module."""
    return (
        (code if isinstance(code, str) else getattr(code, "__module__", "")).partition(":")[0].split(".")[0]
    )


def _package_of(point: metadata.EntryPoint) -> str:
    return _module_of(point.value)


@cache  # once a process: Gymnasium warns of an environment that is registered again
def _call(point: metadata.EntryPoint) -> None:
    """Imports what the entry point names, and calls it where it is a function."""
    try:
        found = point.load()
        if inspect.isroutine(found):
            found()
    except Exception as error:  # whatever the package does
        raise UserError(
            f"The entry point {point.name} = {point.value!r} of {GYMNASIUM} fails ({_reason(error)}): correct its "
            "package or uninstall it, or name the package of your environment in task.package."
        ) from error


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:MAX_REASON]


def cameras_of(package: str | None, env: Any) -> Cameras | None:
    """Takes over the drawing of an environment whose package is known here; None for others."""
    if package not in ADAPTERS:
        return None
    adapt: Callable[[Any], Cameras] = import_module(ADAPTERS[package]).adapt
    return adapt(env)


def version_of(package: str | None) -> str:
    """The package and its version, such as "gym_aloha 0.1.3".

    Its distribution may have another name; an entry point says which. Without any version the name alone.
    """
    name = package or "gymnasium"
    for point in (point for group in GROUPS for point in metadata.entry_points(group=group)):
        if _package_of(point) == name and point.dist is not None:
            return f"{name} {point.dist.version}"
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:  # such as of a folder on PYTHONPATH
        return name
