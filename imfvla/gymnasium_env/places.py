"""Values inside the nested mappings that Gymnasium calls observation and info, by places such as "info/is_success"."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from imfvla.errors import UserError


def value_at(place: str, found: Mapping[str, Any], key: str) -> Any:
    """The value at `place` of {"observation": ..., "info": ...}. UserError naming `key` where there is none."""
    value: Any = found
    names = place.split("/")
    for number, name in enumerate(names):
        if not isinstance(value, Mapping) or name not in value:
            where = "/".join(names[:number])
            known = (
                f"its keys are {', '.join(map(str, value))}"
                if isinstance(value, Mapping)
                else "it has no keys"
            )
            raise UserError(
                f"{key} must be a place of the environment, found {place!r}: in {where}, {known}."
            )
        value = value[name]
    return value


def numbers_at(place: str, found: Mapping[str, Any], key: str) -> np.ndarray:
    """The value at `place` as float32 (n,). UserError where it holds anything but numbers."""
    value = value_at(place, found, key)
    try:
        return np.asarray(value, np.float32).reshape(-1)
    except (TypeError, ValueError) as error:
        raise UserError(f"{key}: {place} must hold numbers, found {type(value).__name__}.") from error


def number_leaves(found: Any, place: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every place that holds numbers, in the order of their names; pictures, which depend on a renderer, apart."""
    if isinstance(found, Mapping):
        for name in sorted(found, key=str):
            yield from number_leaves(found[name], f"{place}/{name}")
        return
    try:
        array = np.asarray(found)
    except ValueError:  # of a ragged list
        return
    if array.dtype.kind in "biuf" and not is_picture(array):
        yield place, array


def is_picture(value: Any) -> bool:
    """Whether it is an array of colour pixels: uint8 (H, W, 3)."""
    return (
        isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3
    )
