"""Values that fit a type, checked at once: what `options.convert` makes of them.

A report reads hundreds of thousands of rows of one type. The checks of a type are put together once and then called for
each value. They have no words for what is wrong: a value that does not pass goes to `options.convert`, which has.
"""

from collections.abc import Callable
from functools import cache
from math import isfinite
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, is_typeddict

from imfvla.errors import UserError
from imfvla.options import MAX_ENTRIES, MAX_TEXT, MAX_WHOLE, Limit, Plain, convert, hints_of

UNFIT = object()
Check = Callable[[Any], Any]  # the converted value, or UNFIT
NUMBERS = {int: frozenset({int}), float: frozenset({int, float})}  # and what is taken for them


@cache
def check_of(hint: Any) -> Check:
    """The check of a type. A value may be unfit that `options.convert` takes, but not the other way round."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _limited(check_of(hint.__origin__), hint.__metadata__)
    if origin in (Union, UnionType) and len(arguments) == 2 and type(None) in arguments:
        check = check_of(arguments[arguments[0] is type(None)])
        return lambda value: None if value is None else check(value)
    if origin is list:
        return _list_of(arguments[0])
    if is_typeddict(hint):
        return _record(hint)
    return SCALARS[hint] if hint in SCALARS else _converted(hint)


def _whole(value: Any) -> Any:
    return value if type(value) is int and -MAX_WHOLE <= value <= MAX_WHOLE else UNFIT


def _number(value: Any) -> Any:
    if type(value) is float:
        return value if isfinite(value) else UNFIT
    return UNFIT if _whole(value) is UNFIT else float(value)


def _flag(value: Any) -> Any:
    return value if type(value) is bool else UNFIT


def _text(value: Any) -> Any:
    return value if type(value) is str and len(value) <= MAX_TEXT else UNFIT


SCALARS: dict[Any, Check] = {int: _whole, float: _number, bool: _flag, str: _text}


def _limited(check: Check, limits: tuple[Limit, ...]) -> Check:
    every = [limit.holds for limit in limits]

    def within(value: Any) -> Any:
        found = check(value)
        if found is not UNFIT:
            for holds in every:
                if not holds(found):
                    return UNFIT
        return found

    return within


def _list_of(element: Any) -> Check:
    kind, limits = (
        (element.__origin__, element.__metadata__) if get_origin(element) is Annotated else (element, ())
    )
    if kind in NUMBERS and all(limit.is_range for limit in limits):
        return _numbers(kind, limits)
    check = check_of(element)

    def entries(values: Any) -> Any:
        if type(values) is not list or len(values) > MAX_ENTRIES:
            return UNFIT
        found = [check(value) for value in values]
        return UNFIT if any(value is UNFIT for value in found) else found

    return entries


def _numbers(kind: type, limits: tuple[Limit, ...]) -> Check:
    """Of a list of numbers in a range, of which the least and the greatest tell about all."""

    def numbers(values: Any) -> Any:
        if type(values) is not list or len(values) > MAX_ENTRIES:
            return UNFIT
        kinds = set(map(type, values))
        if not kinds <= NUMBERS[kind]:
            return UNFIT
        if values:
            ends = min(values), max(values)
            # a sum with a number that is not finite is none either
            if not (ends[0] >= -MAX_WHOLE and ends[1] <= MAX_WHOLE and isfinite(sum(values))):
                return UNFIT
            if not all(limit.holds(end) for limit in limits for end in ends):
                return UNFIT
        return list(values) if kinds <= {kind} else [kind(value) for value in values]

    return numbers


def _record(hint: Any) -> Check:
    checks = {name: check_of(of_name) for name, of_name in hints_of(hint).items()}
    required, other = hint.__required_keys__, check_of(Plain)

    def record(value: Any) -> Any:
        if type(value) is not dict or len(value) > MAX_ENTRIES or not required <= value.keys():
            return UNFIT
        found = {}
        for name, item in value.items():
            check = checks.get(name)
            if check is None:
                if _text(name) is UNFIT:
                    return UNFIT
                check = other
            if (converted := check(item)) is UNFIT:
                return UNFIT
            found[name] = converted
        return found

    return record


def _converted(hint: Any) -> Check:
    def converted(value: Any) -> Any:
        try:
            return convert(value, hint, "")
        except UserError:
            return UNFIT

    return converted
