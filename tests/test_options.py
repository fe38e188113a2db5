import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, NotRequired, TypedDict

import pytest

from imfvla.errors import UserError
from imfvla.options import MAX_DEPTH, MAX_TEXT, Number, Plain, at_most, build, convert, require, shown, within


@dataclass(frozen=True, slots=True)
class Example:
    count: int
    rate: float
    name: str
    flag: bool
    pair: tuple[float, float]
    many: tuple[int, ...]
    limit: int | None
    extra: float = 1.0


GOOD = {"count": 2, "rate": 1, "name": "a", "flag": True, "pair": [1, 2.5], "many": [1, 2, 3], "limit": None}


def test_takes_plain_values():
    built = build(Example, GOOD, "group")
    assert built == Example(2, 1.0, "a", True, (1.0, 2.5), (1, 2, 3), None)
    assert isinstance(built.rate, float)
    assert build(Example, GOOD | {"limit": 3}, "group").limit == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cuont": 1}, r"Unknown key group\.cuont \(did you mean count\?\); known are count, rate"),
        ({"count": 1.5}, r"group\.count must be a whole number, found 1\.5"),
        ({"count": True}, r"group\.count must be a whole number, found True"),
        ({"count": None}, r"group\.count must be a whole number, found None"),
        ({"rate": "fast"}, r"group\.rate must be a finite number, found 'fast'"),
        ({"rate": float("nan")}, r"group\.rate must be a finite number, found nan"),
        ({"flag": "yes"}, r"group\.flag must be true or false"),
        ({"name": 3}, r"group\.name must be a text"),
        ({"pair": [1.0]}, r"group\.pair must be a list of 2 entries"),
        ({"many": [1, "x"]}, r"group\.many\[1\] must be a whole number"),
        ({"many": 3}, r"group\.many must be a list"),
        ({"limit": "x"}, r"group\.limit must be null or a whole number"),
    ],
)
def test_names_the_key_that_is_wrong(changes, message):
    with pytest.raises(UserError, match=message):
        build(Example, GOOD | changes, "group")


def test_names_missing_keys():
    values = {key: value for key, value in GOOD.items() if key not in ("count", "flag")}
    with pytest.raises(UserError, match=r"Missing key group\.count, group\.flag"):
        build(Example, values, "group")
    with pytest.raises(UserError, match="group must be a mapping"):
        build(Example, 3, "group")


def test_require():
    require(True, "key", "anything", None)
    with pytest.raises(UserError, match="key must be odd, found 2"):
        require(False, "key", "odd", 2)


class Part(TypedDict):
    level: Annotated[float, within(0, 1)]


class Record(TypedDict):
    name: str
    part: Part
    times: Annotated[list[float], at_most(3)]
    counts: Mapping[str, int]
    mean: NotRequired[Number | None]


WHOLE = {
    "name": "a",
    "part": {"level": 1},
    "times": [1.5, 2],
    "counts": {"x": 1},
    "newer": {"key": [1, None]},
}


def test_a_record_keeps_its_order_and_what_another_version_wrote():
    found = convert(WHOLE, Record, "")
    assert found == WHOLE
    assert list(found) == list(WHOLE)
    assert isinstance(found["part"]["level"], float)
    assert found is not WHOLE
    assert math.isnan(convert(WHOLE | {"mean": math.nan}, Record, "")["mean"])


def deep(levels):
    return [deep(levels - 1)] if levels else []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"part": {}}, r"^part lacks level\."),
        ({"part": {"level": 2}}, r"part\.level must be between 0 and 1, found 2"),
        ({"part": [1]}, r"part must be a mapping of keys to values, found \[1\]"),
        ({"times": [1.0, "2"]}, r"times\[1\] must be a finite number, found '2'"),
        ({"times": [1.0, math.inf]}, r"times\[1\] must be a finite number, found inf"),
        ({"times": [1.0] * 4}, r"times must be of length 3 at most"),
        ({"counts": {"x": True}}, r"counts\.x must be a whole number, found True"),
        ({"counts": {"x": 10**30}}, r"counts\.x must be a whole number up to"),
        ({"counts": {1: 1}}, r"a key of counts must be a text, found 1"),
        ({"mean": "1"}, r"mean must be null or a number, found '1'"),
        ({"name": "x" * (MAX_TEXT + 1)}, rf"name must be a text of at most {MAX_TEXT} characters"),
        ({"newer": math.nan}, r"newer must be a finite number, found nan"),
        ({"newer": {1, 2}}, r"newer must be a number, a text, true, false, a list or a mapping"),
        ({"newer": deep(MAX_DEPTH + 1)}, rf"must be nested at most {MAX_DEPTH} levels deep"),
    ],
)
def test_a_record_is_of_its_types_and_within_its_limits(changes, message):
    with pytest.raises(UserError, match=message):
        convert(WHOLE | changes, Record, "")


def test_plain_values_are_copied():
    value = {"a": [1, 2.5, "x", None, True, {}]}
    assert convert(value, Plain, "key") == value
    with pytest.raises(UserError, match=r"key\.a\[0\] must be a whole number up to"):
        convert({"a": [10**400]}, Plain, "key")


def test_a_long_value_is_shortened_in_a_message():
    assert len(shown("x" * 10**6)) < 1000
    assert len(shown([[0] * 1000] * 1000)) < 10_000
    assert shown(1 << 50_000) == "a number of thousands of digits"
