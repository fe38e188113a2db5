"""Plain values become typed ones: mappings of a config frozen dataclasses, records of a file TypedDicts.

A dataclass fails on unknown keys, which a user has misspelt. A TypedDict keeps them as plain values: another version
may have written them. Both fail on missing and ill-typed ones. Numbers, texts and lists have limits everywhere.
"""

import math
import types
from collections.abc import Callable, Mapping, Sized
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from reprlib import Repr
from typing import (
    Annotated,
    Any,
    NewType,
    NotRequired,
    Required,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from imfvla.errors import UserError

T = TypeVar("T")
Number = NewType("Number", float)  # also one that is not finite, as a mean over nothing
Plain = NewType("Plain", object)  # what JSON has: null, numbers, texts, flags, lists and mappings of them
MAX_WHOLE = 2**63 - 1  # the largest that arrays hold
MAX_TEXT = 100_000  # characters
MAX_ENTRIES = 1_000_000  # of a list or a mapping
MAX_DEPTH = 32  # of lists and mappings in each other
_SCALARS = frozenset({bool, int, float, str})
_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "a text",
    Number: "a number",
}


@dataclass(frozen=True, slots=True)
class Limit:
    """What a value must be besides its type, as part of the type of its field: `steps: Annotated[int, at_least(1)]`."""

    wanted: str
    holds: Callable[[Any], bool]
    is_of_length: bool = False  # then it is checked before the entries, of which there may be millions
    is_range: bool = False  # then it holds for what lies between two numbers for which it holds


def at_least(lowest: float) -> Limit:
    """Numbers from `lowest` on."""
    return Limit(f"at least {lowest}", lambda value: value >= lowest, is_range=True)


def above(bound: float) -> Limit:
    """Numbers greater than `bound`."""
    return Limit(f"above {bound}", lambda value: value > bound, is_range=True)


def within(lowest: float, highest: float) -> Limit:
    """Numbers from `lowest` to `highest`, both included."""
    return Limit(f"between {lowest} and {highest}", lambda value: lowest <= value <= highest, is_range=True)


def one_of(*choices: Any) -> Limit:
    """One of the values themselves."""
    return Limit(f"one of {', '.join(map(str, choices))}", lambda value: value in choices)


def some(each: Limit) -> Limit:
    """Lists of at least one entry, each of them within the limit."""
    return Limit(
        f"one or more values, each {each.wanted}",
        lambda values: bool(values) and all(map(each.holds, values)),
    )


def at_most(entries: int) -> Limit:
    """Texts of at most so many characters, and lists and mappings of at most so many entries."""
    return Limit(f"of length {entries} at most", lambda value: len(value) <= entries, True)


def within_length(fewest: int, most: int) -> Limit:
    """Lists of so many entries."""
    return Limit(f"a list of {fewest} to {most} entries", lambda value: fewest <= len(value) <= most, True)


def of_length(entries: int) -> Limit:
    """Lists of so many entries."""
    return Limit(f"a list of {entries} entries", lambda value: len(value) == entries, True)


DIFFERENT = Limit("values that all differ", lambda values: len(set(values)) == len(values))
SHARE_BELOW_1 = Limit("in [0, 1)", lambda value: 0 <= value < 1)


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """`cls(**values)` for a dataclass of numbers, texts, flags, other such dataclasses and tuples of them.

    `where` is the config key of `values`, such as "training", or "" at the top; it heads every message. Whole numbers
    are taken for float fields, lists for tuples. Raises UserError naming the key, what was wanted and what was found:
    unknown and missing keys, values of another type, and those beyond a `Limit`.
    """
    if not isinstance(values, Mapping):
        raise UserError(
            f"{where or 'the config'} must be a mapping of keys to values, found {shown(values)}."
        )
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
    hints = hints_of(cls)
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
        raise UserError(f"{key} must be {wanted}, found {shown(found)}.")


def suggestion(name: Any, known: Any) -> str:
    """The text " (did you mean ...?)" for a near miss, else nothing."""
    near = get_close_matches(str(name), [str(other) for other in known], n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def shown(value: Any) -> str:
    """A value in a message, shortened where it is long."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        return "a number of thousands of digits"


def convert(value: Any, hint: Any, key: str, prefix: str = "") -> Any:
    """`value` as the type `hint`, or a UserError; `prefix` heads what is wanted.

    Types are those that `build` takes, and TypedDict, list, Mapping with texts as keys, `Number` and `Plain`.
    """
    if hint.__class__ is type and hint in _SCALARS:  # the most frequent ones first
        require(_FITS[hint](value), key, prefix + _KINDS[hint], value)
        if hint is str and len(value) > MAX_TEXT:
            require(False, key, f"a text of at most {MAX_TEXT} characters", value)
        if hint is int and not -MAX_WHOLE <= value <= MAX_WHOLE:
            require(False, key, f"a whole number up to {MAX_WHOLE}", value)
        return float(value) if hint is float else value
    origin = get_origin(hint)
    if origin is Annotated:
        for limit in hint.__metadata__:
            if limit.is_of_length and isinstance(value, Sized) and not limit.holds(value):
                require(False, key, prefix + limit.wanted, value)
        converted = convert(value, hint.__origin__, key, prefix)
        for limit in hint.__metadata__:
            if not limit.holds(converted):
                require(False, key, prefix + limit.wanted, value)
        return converted
    if origin in (Union, types.UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not type(None)]
        is_optional = len(kinds) < len(get_args(hint))
        if value is None and is_optional:
            return None
        fitting = kinds if len(kinds) == 1 else [kind for kind in kinds if kind is type(value)]
        if not fitting:
            raise UserError(
                f"{key} must be {' or '.join(_KINDS[kind] for kind in kinds)}, found {shown(value)}."
            )
        return convert(value, fitting[0], key, "null or " if is_optional else prefix)
    if origin is tuple:
        require(isinstance(value, list | tuple), key, f"{prefix}a list", value)
        element, *rest = get_args(hint)
        if rest and rest != [Ellipsis]:
            require(len(value) == 1 + len(rest), key, f"a list of {1 + len(rest)} entries", value)
        return tuple(_entries(value, element, key))
    if origin is list:
        require(isinstance(value, list | tuple), key, f"{prefix}a list", value)
        return _entries(value, get_args(hint)[0], key)
    if origin in (dict, Mapping):
        return _mapping(value, key, lambda name: get_args(hint)[1], prefix)
    if is_dataclass(hint):
        return build(hint, value, key)
    if is_typeddict(hint):
        hints = hints_of(hint)
        found = _mapping(value, key, lambda name: hints.get(name, Plain), prefix)
        if missing := [name for name in hints if name in hint.__required_keys__ and name not in found]:
            raise UserError(f"{key or 'it'} lacks {', '.join(missing)}.")
        return found
    if hint is Any:
        return value
    if hint is Plain:
        return _plain(value, key)
    require(_FITS[hint](value), key, prefix + _KINDS[hint], value)
    return value


def is_whole(value: Any) -> bool:
    """Whether it is an int, which True and False are not."""
    return isinstance(value, int) and not isinstance(value, bool)


@cache
def hints_of(cls: type) -> dict[str, Any]:
    """The types of a class's fields by name."""
    hints = get_type_hints(cls, include_extras=True)
    return {
        name: get_args(hint)[0] if get_origin(hint) in (Required, NotRequired) else hint
        for name, hint in hints.items()
    }


def _mapping(value: Any, key: str, hint_of: Callable[[str], Any], prefix: str = "") -> dict[str, Any]:
    require(isinstance(value, Mapping), key or "it", f"{prefix}a mapping of keys to values", value)
    require(len(value) <= MAX_ENTRIES, key or "it", f"a mapping of at most {MAX_ENTRIES} keys", len(value))
    found = {}
    for name, item in value.items():
        if not (isinstance(name, str) and len(name) <= MAX_TEXT):
            require(False, f"a key of {key or 'it'}", "a text", name)
        found[name] = convert(item, hint_of(name), f"{key}.{name}" if key else name)
    return found


def _entries(values: Any, hint: Any, key: str) -> list[Any]:
    """The converted entries of a list."""
    require(len(values) <= MAX_ENTRIES, key, f"a list of at most {MAX_ENTRIES} entries", len(values))
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    is_optional = get_origin(hint) in (Union, types.UnionType) and len(kinds) == 1 < len(get_args(hint))
    alone = kinds[0] if is_optional else hint
    kind, limits = (alone.__origin__, alone.__metadata__) if get_origin(alone) is Annotated else (alone, ())
    # Thousands of numbers are checked together, without a name for each.
    if kind in _TOGETHER and all(
        type(item) in _TOGETHER[kind] or (is_optional and item is None) for item in values
    ):
        found = [item if item is None else kind(item) for item in values if _is_bounded(item)]
        counted = [item for item in found if item is not None] if is_optional else found
        if len(found) == len(values) and all(all(map(limit.holds, counted)) for limit in limits):
            return found
    return [convert(item, hint, f"{key}[{index}]") for index, item in enumerate(values)]


def _plain(value: Any, key: str, depth: int = 0) -> Any:
    """A value that JSON could have, within the limits."""
    require(depth <= MAX_DEPTH, key or "it", f"nested at most {MAX_DEPTH} levels deep", "a deeper value")
    if isinstance(value, Mapping):
        items = _mapping(value, key, lambda name: Any).items()
        return {name: _plain(item, f"{key}.{name}" if key else name, depth + 1) for name, item in items}
    if isinstance(value, list | tuple):
        require(len(value) <= MAX_ENTRIES, key, f"a list of at most {MAX_ENTRIES} entries", len(value))
        if all(map(_is_plain_number, value)):  # thousands of them are checked without a name for each
            return list(value)
        return [_plain(item, f"{key}[{index}]", depth + 1) for index, item in enumerate(value)]
    if value is None:
        return None
    require(type(value) in _SCALARS, key or "it", "a number, a text, true, false, a list or a mapping", value)
    return convert(value, type(value), key)


def _is_plain_number(value: Any) -> bool:
    return value is None or (value.__class__ in _NUMBERS and _is_bounded(value))


def _is_bounded(value: Any) -> bool:
    """Whether a number is finite, and one that arrays hold where it is whole."""
    return value is None or (
        math.isfinite(value) if value.__class__ is float else -MAX_WHOLE <= value <= MAX_WHOLE
    )


def _is_finite(value: Any) -> bool:
    try:
        return _is_number(value) and math.isfinite(value)
    except OverflowError:  # of a whole number with hundreds of digits
        return False


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_FITS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool),
    int: is_whole,
    float: _is_finite,
    str: lambda value: isinstance(value, str),
    Number: lambda value: isinstance(value, float) or _is_finite(value),
}
_NUMBERS = frozenset({int, float, bool})
_TOGETHER = {int: frozenset({int}), float: frozenset({int, float})}
_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxdict, _SHORT.maxlist, _SHORT.maxtuple = 4, 20, 20, 20
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 200
