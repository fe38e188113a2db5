"""A robot's channels as nested JSON: "left/joint_1 [rad]" is the number at `left.joint_1`, "gripper [0, 1]" a flat one.

Numbers then have plot paths, as in `/robot/state.left.joint_1`.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from imfvla.recording.schemas import NUMBER, Schema, object_of
from imfvla.robot import bare_name

Tree = dict[
    str, Any
]  # nested by the slashes of the names; a number or None, which is not finite, at each end


class Misfit(ValueError):
    """A message that does not have a robot's channels: `key` of it, what it must be and what it is."""

    def __init__(self, key: str, wanted: str, found: str) -> None:
        super().__init__(f"{key} must be {wanted}, found {found}")


class Channels:
    """Some channels of a robot in their order; C is their number."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(bare_name(name) for name in names)
        self._paths = [tuple(name.split("/")) for name in self.names]

    def tree(self, values: np.ndarray) -> Tree:
        """The message of values (C,)."""
        tree: Tree = {}
        for (*groups, last), value in zip(self._paths, numbers(values), strict=True):
            reduce(lambda part, group: part.setdefault(group, {}), groups, tree)[last] = value
        return tree

    def schema(self, title: str) -> Schema:
        """JSON Schema of such messages."""
        tree: Tree = {}
        for *groups, last in self._paths:
            reduce(lambda part, group: part.setdefault(group, {}), groups, tree)[last] = None
        return _schema(title, tree)

    def values(self, tree: Any) -> list[float | None]:
        """Inverse of `tree`. Raises Misfit where a channel is missing, is no number, or is of another robot."""
        found = []
        for name, path in zip(self.names, self._paths, strict=True):
            value = tree
            for part in path:
                if not isinstance(value, dict) or part not in value:
                    raise Misfit(name, "there", f"only {_listed(_names(tree))}")
                value = value[part]
            if value is not None and not isinstance(value, int | float):
                raise Misfit(name, "a number", repr(value)[:80])
            found.append(value)
        if len(found) != sum(1 for _ in _names(tree)):
            unknown = [name for name in _names(tree) if name not in self.names]
            raise Misfit(unknown[0], f"absent from the {len(found)} channels", "a value")
        return found


def numbers(values: np.ndarray) -> list:
    """Nested lists of an array's numbers, None where one is not finite."""
    values = np.asarray(values)
    return (values if np.isfinite(values).all() else np.where(np.isfinite(values), values, None)).tolist()


def _schema(title: str, tree: Tree) -> Schema:
    parts = {
        name: NUMBER if part is None else _schema(f"{title}.{name}", part) for name, part in tree.items()
    }
    return object_of(title, **parts)


def _names(tree: Any, prefix: str = "") -> Any:
    """The slashed names of all ends of a tree."""
    if not isinstance(tree, dict):
        yield prefix or "no channels"
        return
    for name, part in tree.items():
        yield from _names(part, f"{prefix}/{name}" if prefix else str(name))


def _listed(names: Any) -> str:
    return ", ".join(names)[:200] or "nothing"
