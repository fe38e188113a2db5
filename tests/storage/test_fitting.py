"""Fast checks agree with `options.convert`: equal values of equal types, and nothing that it refuses."""

import copy
import json
import math
from typing import Annotated, Any

import pytest

from imfvla.errors import UserError
from imfvla.options import above, convert, one_of, within
from imfvla.reporting.records import Row, Summary
from imfvla.storage.fitting import UNFIT, check_of

ROW = {
    "seed": 100_000, "start_digest": "a0", "num_steps": 400, "total_reward": 812.0, "max_reward": 4, "success": True,
    "first_step_of_stage": [3, 40, -1], "failure": None, "timing": {"wall_s": 1.5, "inference_ms": [7, 7.5, 8.25]},
}  # fmt: skip
SUMMARY = {
    "name": "a", "experiment": "b", "nfe": 1, "checkpoint_step": 5, "seeds": [100_000, 100_099], "stages": ["held"],
    "protocol": {"task": "socket", "variant": "default", "noise_scale": 1, "delay_ms": "measured", "more": {"a": [1]}},
    "fingerprint": {"machine": {"cpu": "x"}, "threads": 1}, "failures": {"dropped": 3}, "inference_fps": None,
}  # fmt: skip
OTHERS = (
    None, True, 0, -1, 1, 2.5, math.nan, math.inf, -math.inf, 2**63, 10**400, 1e30, "", "x", "a\u202e", [], [1],
    [1, None], [2.5, math.nan], [math.nan, 2.5], [math.inf, -math.inf], [2**63, 1.0], ["x"], [[1]], {}, {"a": 1},
    {"a": {"b": None}},
)  # fmt: skip


def typed(value: Any) -> Any:
    """The value with the types of all that it has."""
    if isinstance(value, dict):
        return {key: typed(item) for key, item in value.items()}
    return [typed(item) for item in value] if isinstance(value, list) else (type(value), value)


def converted(value: Any, hint: Any) -> Any:
    try:
        return convert(value, hint, "")
    except UserError:
        return UNFIT


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """The path of each value in a mapping."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [path, *(found for key, item in items for found in places(item, (*path, key)))]
    return [path]


def changed(whole: Any, path: tuple, value: Any) -> Any:
    if not path:
        return value
    copied = part = copy.deepcopy(whole)
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return copied


def without(whole: Any, path: tuple) -> Any:
    copied = part = copy.deepcopy(whole)
    for key in path[:-1]:
        part = part[key]
    del part[path[-1]]
    return copied


@pytest.mark.parametrize(("hint", "whole"), [(Row, ROW), (Summary, SUMMARY)], ids=["row", "summary"])
def test_what_files_hold_passes_at_once(hint, whole):
    assert typed(check_of(hint)(whole)) == typed(convert(whole, hint, ""))
    read = json.loads(json.dumps(whole))
    assert typed(check_of(hint)(read)) == typed(convert(whole, hint, ""))


@pytest.mark.parametrize(("hint", "whole"), [(Row, ROW), (Summary, SUMMARY)], ids=["row", "summary"])
def test_nothing_passes_that_would_be_refused_or_become_another_value(hint, whole):
    damaged = [changed(whole, path, value) for path in places(whole) for value in OTHERS]
    damaged += [without(whole, path) for path in places(whole) if path]
    damaged += [whole | {"unknown": value} for value in OTHERS]
    passed = 0
    for value in damaged:
        found = check_of(hint)(value)
        if found is not UNFIT:
            passed += 1
            assert repr(typed(found)) == repr(typed(converted(value, hint)))
    assert 0 < passed < len(damaged)


@pytest.mark.parametrize(
    "hint",
    [
        list[Annotated[float, within(-1, 2)]],
        list[Annotated[int, above(0)]],
        list[Annotated[int, one_of(1, 3)]],  # of which the least and the greatest do not tell about all
        list[float | None],
        list[bool],
    ],
)
def test_lists_of_numbers_within_limits(hint):
    lists = [[1, 2, 3], [1, 3], [0.5, 2], [-1, 0.5], [-1.5, 0], [2, 2.5], [None, 1.0], [True, False], *OTHERS]
    for value in lists:
        found = check_of(hint)(value)
        assert found is UNFIT or repr(typed(found)) == repr(typed(converted(value, hint))), value
