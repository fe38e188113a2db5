"""Plain mappings become small frozen dataclasses, which fail on unknown, missing and ill-typed keys."""

import math
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from imfvla.errors import UserError

T = TypeVar("T")
_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text"}


@dataclass(frozen=True, slots=True)
class Limit:
    """What a value must be besides its type, as part of the type of its field: `steps: Annotated[int, at_least(1)]`."""

    wanted: str
    holds: Callable[[Any], bool]


def at_least(lowest: float) -> Limit:
    """Numbers from `lowest` on."""
    return Limit(f"at least {lowest}", lambda value: value >= lowest)


def above(bound: float) -> Limit:
    """Numbers greater than `bound`."""
    return Limit(f"above {bound}", lambda value: value > bound)


def within(lowest: float, highest: float) -> Limit:
    """Numbers from `lowest` to `highest`, both included."""
    return Limit(f"between {lowest} and {highest}", lambda value: lowest <= value <= highest)


def one_of(*choices: Any) -> Limit:
    """One of the values themselves."""
    return Limit(f"one of {', '.join(map(str, choices))}", lambda value: value in choices)


def some(each: Limit) -> Limit:
    """Lists of at least one entry, each of them within the limit."""
    return Limit(
        f"one or more values, each {each.wanted}",
        lambda values: bool(values) and all(map(each.holds, values)),
    )


SHARE_BELOW_1 = Limit("in [0, 1)", lambda value: 0 <= value < 1)


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """`cls(**values)` for a dataclass of numbers, texts, flags, other such dataclasses and tuples of them.

    `where` is the config key of `values`, such as "training", or "" at the top; it heads every message. Whole numbers
    are taken for float fields, lists for tuples. Raises UserError naming the key, what was wanted and what was found:
    unknown and missing keys, values of another type, and those beyond a `Limit`.
    """
    if not isinstance(values, Mapping):
        raise UserError(f"{where or 'the config'} must be a mapping of keys to values, found {values!r}.")
    prefix = f"{where}." if where else ""
    known = {field.name: field for field in fields(cls)}
    for key in values:
        if key not in known:
            raise UserError(
                f"Unknown key {prefix}{key}{suggestion(str(key), known)}; known are {', '.join(known)}."
            )
    required = [
        name for name, field in known.items() if field.default is MISSING and field.default_factory is MISSING
    ]
    missing = [f"{prefix}{name}" for name in required if name not in values]
    if missing:
        raise UserError(
            f"Missing key {', '.join(missing)}: give it a value in the config or on the command line."
        )
    hints = get_type_hints(cls, include_extras=True)
    return cls(**{key: convert(value, hints[key], f"{prefix}{key}") for key, value in values.items()})


def part_of(config: Mapping[str, Any], key: str) -> Any:
    """The value of a config under a dotted key. Raises UserError where it was deleted or its parent is no mapping."""
    found: Any = config
    for number, name in enumerate(parts := key.split(".")):
        if not isinstance(found, Mapping) or name not in found:
            raise UserError(f"Missing key {'.'.join(parts[: number + 1])}: keep it as in the config files.")
        found = found[name]
    return found


def require(condition: bool, key: str, wanted: str, found: Any) -> None:
    """Raises a UserError "`key` must be `wanted`, found `found`." unless the condition holds."""
    if not condition:
        raise UserError(f"{key} must be {wanted}, found {found!r}.")


def suggestion(name: str, known: Any) -> str:
    """The text " (did you mean ...?)" for a near miss, else nothing."""
    near = get_close_matches(name, [str(other) for other in known], n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def convert(value: Any, hint: Any, key: str, prefix: str = "") -> Any:
    """`value` as the type `hint`, one that `build` takes, or a UserError; `prefix` heads what is wanted."""
    if get_origin(hint) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not type(None)]
        is_optional = len(kinds) < len(get_args(hint))
        if value is None and is_optional:
            return None
        fitting = kinds if len(kinds) == 1 else [kind for kind in kinds if kind is type(value)]
        if not fitting:
            raise UserError(f"{key} must be {' or '.join(_KINDS[kind] for kind in kinds)}, found {value!r}.")
        return convert(value, fitting[0], key, "null or " if is_optional else prefix)
    if get_origin(hint) is Annotated:
        kind, *limits = get_args(hint)
        converted = convert(value, kind, key, prefix)
        for limit in limits:
            require(limit.holds(converted), key, prefix + limit.wanted, value)
        return converted
    if get_origin(hint) is tuple:
        require(isinstance(value, list | tuple), key, "a list", value)
        element, *rest = get_args(hint)
        if rest and rest != [Ellipsis]:
            require(len(value) == 1 + len(rest), key, f"a list of {1 + len(rest)} entries", value)
        return tuple(convert(item, element, f"{key}[{index}]") for index, item in enumerate(value))
    if is_dataclass(hint):
        return build(hint, value, key)
    if hint is Any:
        return value
    require(_FITS[hint](value), key, prefix + _KINDS[hint], value)
    return float(value) if hint is float else value


def is_whole(value: Any) -> bool:
    """Whether it is an int, which True and False are not."""
    return isinstance(value, int) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    try:
        return (is_whole(value) or isinstance(value, float)) and math.isfinite(value)
    except OverflowError:  # of a whole number with hundreds of digits
        return False


_FITS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool),
    int: is_whole,
    float: _is_finite,
    str: lambda value: isinstance(value, str),
}
