"""A robot's channels as nested JSON: "left/joint_1 [rad]" is the number at `left.joint_1`, "gripper [0, 1]" a flat one.

Numbers then have plot paths, as in `/robot/state.left.joint_1`.
"""

from collections.abc import Iterator, Sequence
from functools import reduce
from types import NoneType
from typing import Any

import numpy as np

from imfvla.recording.schemas import NUMBER, Schema, object_of
from imfvla.robot import bare_name

Number = float | None  # None where it is not finite
NUMBERS = (float, int, NoneType)  # what JSON has for it
Tree = dict[str, Any]  # nested by the slashes of the names, a Number at each end


class Misfit(ValueError):
    """A message that does not have a robot's channels: `key` of it, what it must be and what it is."""

    def __init__(self, key: str, wanted: str, found: str) -> None:
        super().__init__(f"{key} must be {wanted}, found {found}")


class Channels:
    """Some channels of a robot in their order; C is their number."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(bare_name(name) for name in names)
        self._places: Tree = {}  # the tree with the index of each channel at its end
        for index, name in enumerate(self.names):
            *groups, last = name.split("/")
            reduce(lambda part, group: part.setdefault(group, {}), groups, self._places)[last] = index

    def tree(self, values: np.ndarray) -> Tree:
        """The message of values (C,)."""
        if len(values) != len(self.names):
            raise ValueError(f"Wanted {len(self.names)} values, found {len(values)}.")
        return _filled(self._places, numbers(values))

    def schema(self, title: str) -> Schema:
        """JSON Schema of such messages."""
        return _schema(title, self._places)

    def values(self, tree: Any) -> list[Number]:
        """Inverse of `tree`. Raises Misfit where a channel is missing, is no number, or is of another robot."""
        found: list[Number] = [None] * len(self.names)
        if _take(tree, self._places, found):
            return found
        there = dict(_ends(tree))
        for name in self.names:
            if name not in there:
                raise Misfit(name, "there", f"only {', '.join(there)[:200] or 'nothing'}")
            if type(there[name]) not in NUMBERS:
                raise Misfit(name, "a number", repr(there[name])[:80])
        unknown = next(name for name in there if name not in self.names)
        raise Misfit(unknown, f"absent from the {len(found)} channels", "a value")


def numbers(values: np.ndarray) -> list:
    """Nested lists of an array's numbers, None where one is not finite."""
    values = np.asarray(values)
    return (values if np.isfinite(values).all() else np.where(np.isfinite(values), values, None)).tolist()


def _filled(places: Tree, values: list) -> Tree:
    return {
        name: _filled(place, values) if isinstance(place, dict) else values[place]
        for name, place in places.items()
    }


def _take(tree: Any, places: Tree, found: list[Number]) -> bool:
    """Puts the numbers of a tree into their places; False where it is of other channels."""
    if not isinstance(tree, dict) or tree.keys() != places.keys():
        return False
    for name, place in places.items():
        value = tree[name]
        if isinstance(place, dict):
            if not _take(value, place, found):
                return False
        elif type(value) not in NUMBERS:
            return False
        else:
            found[place] = value
    return True


def _schema(title: str, places: Tree) -> Schema:
    parts = {
        name: _schema(f"{title}.{name}", place) if isinstance(place, dict) else NUMBER
        for name, place in places.items()
    }
    return object_of(title, **parts)


def _ends(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The slashed names of all ends of a tree, with what is there."""
    if not isinstance(tree, dict):
        yield prefix, tree
        return
    for name, part in tree.items():
        yield from _ends(part, f"{prefix}/{name}" if prefix else str(name))
