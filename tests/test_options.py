from dataclasses import dataclass

import pytest

from imfvla.errors import UserError
from imfvla.options import build, require


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
