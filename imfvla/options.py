"""Plain mappings become small frozen dataclasses, which fail on unknown, missing and ill-typed keys."""

import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields
from difflib import get_close_matches
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from imfvla.errors import UserError

T = TypeVar("T")


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """`cls(**values)` for a dataclass of numbers, texts, flags and tuples of them.

    `where` is the config key of `values`, such as "training"; it heads every message. Whole numbers are taken
    for float fields, lists for tuples. Raises UserError naming the key, what was wanted and what was found.
    """
    if not isinstance(values, Mapping):
        raise UserError(f"{where} must be a mapping of keys to values, found {values!r}.")
    known = {field.name: field for field in fields(cls)}
    for key in values:
        if key not in known:
            raise UserError(
                f"Unknown key {where}.{key}{suggestion(str(key), known)}; known are {', '.join(known)}."
            )
    required = [
        name for name, field in known.items() if field.default is MISSING and field.default_factory is MISSING
    ]
    missing = [f"{where}.{name}" for name in required if name not in values]
    if missing:
        raise UserError(
            f"Missing key {', '.join(missing)}: give it a value in the config or on the command line."
        )
    hints = get_type_hints(cls)
    return cls(**{key: _convert(value, hints[key], f"{where}.{key}") for key, value in values.items()})


def require(condition: bool, key: str, wanted: str, found: Any) -> None:
    """Raises a UserError "`key` must be `wanted`, found `found`." unless the condition holds."""
    if not condition:
        raise UserError(f"{key} must be {wanted}, found {found!r}.")


def suggestion(name: str, known: Any) -> str:
    """The text " (did you mean ...?)" for a near miss, else nothing."""
    near = get_close_matches(name, [str(other) for other in known], n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def _convert(value: Any, hint: Any, key: str) -> Any:
    """`value` as the type `hint`, or a UserError."""
    if get_origin(hint) in (Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        hint = next(arg for arg in get_args(hint) if arg is not type(None))
    if get_origin(hint) is tuple:
        require(isinstance(value, list | tuple), key, "a list", value)
        element, *rest = get_args(hint)
        if rest and rest != [Ellipsis]:
            require(len(value) == 1 + len(rest), key, f"a list of {1 + len(rest)} entries", value)
        return tuple(_convert(item, element, f"{key}[{index}]") for index, item in enumerate(value))
    if hint is bool:
        require(isinstance(value, bool), key, "true or false", value)
    elif hint is int:
        require(isinstance(value, int) and not isinstance(value, bool), key, "a whole number", value)
    elif hint is float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        require(is_number and math.isfinite(value), key, "a finite number", value)
        value = float(value)
    elif hint is str:
        require(isinstance(value, str), key, "a text", value)
    return value
