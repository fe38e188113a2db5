"""Classes of other installed packages that configs may name: the entry-point group `imfvla.components`.

A package registers a class in its pyproject.toml. A config then names it as
`_target_: my_package.generators.Consistency`.

    [project.entry-points."imfvla.components"]
    consistency = "my_package.generators:Consistency"
"""

import inspect
from collections.abc import Collection
from importlib import metadata
from typing import Any

from imfvla.errors import UserError

GROUP = "imfvla.components"
MAX_REASON = 200  # characters of what an import says


def registered(target: str) -> type | None:
    """The class that an installed package registers as exactly `target`, None where none does.

    Imports nothing but that class. Raises UserError where it cannot be imported or is no class.
    """
    for point in _points():
        if _target_of(point) == target:
            return _load(point, target)
    return None


def targets() -> list[str]:
    """Every `_target_` that is registered here."""
    return sorted({_target_of(point) for point in _points()})


def packages() -> dict[str, str]:
    """Installed versions of the packages that register components, by name."""
    return {point.dist.name: point.dist.version for point in _points() if point.dist is not None}


def refuse_incomplete(found: Any, contract: type, key: str) -> None:
    """Raises UserError naming what `found`, built for `key`, lacks of what a Protocol class promises."""
    wanted = [name for name in {**contract.__annotations__, **vars(contract)} if not name.startswith("_")]
    if lacking := [name for name in wanted if not hasattr(found, name)]:
        raise UserError(
            f"{key} must offer what {_path(contract)} says, found {_path(type(found))}, which lacks "
            f"{', '.join(lacking)}."
        )


def _points() -> Collection[metadata.EntryPoint]:
    return metadata.entry_points(group=GROUP)


def _target_of(point: metadata.EntryPoint) -> str:
    return point.value.partition("[")[0].strip().replace(":", ".")


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _load(point: metadata.EntryPoint, target: str) -> type:
    package = f"{point.dist.name} {point.dist.version}" if point.dist is not None else "a package"
    try:
        found = point.load()
    except Exception as error:  # whatever the module does while it is imported
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_REASON]
        raise UserError(
            f"{target} cannot be imported, though {package} registers it as {point.name} under {GROUP}: {reason}. "
            "Install that package again, or correct it."
        ) from error
    if not inspect.isclass(found):
        raise UserError(
            f"{target}, which {package} registers as {point.name} under {GROUP}, must be a class, found {found!r:.80}."
        )
    return found
