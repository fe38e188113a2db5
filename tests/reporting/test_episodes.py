"""Rows of episodes.jsonl: what was cut off, changed or mixed up is named with its line."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_runs import episodes_of

from imfvla.errors import UserError
from imfvla.reporting.episodes import read_episodes

SEEDS = range(100_000, 100_004)
ROWS = episodes_of(0.6, SEEDS[0], len(SEEDS), task="socket", latency_ms=5.0)
TEXT = "".join(json.dumps(row) + "\n" for row in ROWS)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "episodes.jsonl"
    path.write_text(TEXT)
    return path


def read(path: Path) -> list[dict]:
    """The rows with lists of times, as they were written."""
    rows = read_episodes(path, SEEDS)
    return [
        {**row, "timing": {**row["timing"], "inference_ms": list(row["timing"]["inference_ms"])}}
        for row in rows
    ]


def test_rows_come_in_the_order_of_their_seeds(path):
    assert read(path) == ROWS
    path.write_text("".join(reversed(TEXT.splitlines(keepends=True))))
    assert read(path) == ROWS


def test_rows_share_their_names_and_hold_times_as_numbers(path):
    first, second, *_ = read_episodes(path, SEEDS)
    assert all(one is other for one, other in zip(first, second, strict=True))
    (again, *_) = read_episodes(path, SEEDS)
    assert first["start_digest"] is again["start_digest"]
    assert first["timing"]["inference_ms"].itemsize == 8


def changed(number: int, **values) -> str:
    rows = [dict(row) for row in ROWS]
    rows[number - 1] |= values
    return "".join(json.dumps(row) + "\n" for row in rows)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TEXT[:-40], "line 4 is cut off before its end"),
        (TEXT[:-1], "line 4 is cut off before its end"),
        (TEXT.replace("{", "", 1), "line 1 is not JSON"),
        ("[]\n" + TEXT, "line 1 must be a mapping"),
        (TEXT.replace('"success"', '"succes"', 1), "line 1 lacks success"),
        (changed(2, total_reward=float("nan")), "line 2: total_reward must be a finite number, found nan"),
        (changed(2, total_reward="10"), "line 2: total_reward must be a finite number, found '10'"),
        (changed(3, success=1), "line 3: success must be true or false, found 1"),
        (changed(3, first_step_of_stage=[1.5]), r"line 3: first_step_of_stage\[0\] must be a whole number"),
        (changed(3, timing={"wall_s": 1.0}), "line 3: timing lacks inference_ms"),
        (changed(2, seed=7), "line 2 is of seed 7, but its summary.json covers 100000 to 100003"),
        (changed(2, seed=100_000), "line 2 repeats the episode of seed 100000"),
        ("".join(TEXT.splitlines(keepends=True)[:3]), "has 3 of 4 episodes: seed 100003 is missing"),
        ("", "has 0 of 4 episodes: seed 100000 is missing"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(path, text, message):
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        read_episodes(path, SEEDS)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_missing_or_no_text(path):
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="cannot be read"):
        read_episodes(path, SEEDS)
    path.unlink()
    with pytest.raises(UserError, match=r"is missing beside its summary\.json"):
        read_episodes(path, SEEDS)


@given(st.integers(0, len(TEXT) - 1), st.binary(max_size=3))
def test_damage_anywhere_is_a_user_error_or_harmless(tmp_path_factory, place, junk):
    damaged = TEXT.encode()[:place] + junk + TEXT.encode()[place + len(junk) :]
    path = tmp_path_factory.mktemp("damaged") / "episodes.jsonl"
    path.write_bytes(damaged)
    try:
        assert len(read_episodes(path, SEEDS)) == len(SEEDS)
    except UserError:
        return
