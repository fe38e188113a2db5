"""Reads the rows of `episodes.jsonl`, which may be cut off or damaged."""

import math
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.reporting.rows import TIMING, Row
from imfvla.storage.documents import parse_json, read_lines

REMEDY = "restore the file or evaluate again with overwrite=true"
SHAPE = {
    "seed": (int, "a whole number"),
    "start_digest": (str, "a text"),
    "num_steps": (int, "a whole number"),
    "total_reward": (float, "a finite number"),
    "max_reward": (float, "a finite number"),
    "success": (bool, "true or false"),
    "first_step_of_stage": (list, "a list"),
    "failure": (str | None, "text or null"),
    TIMING: (dict, "a mapping"),
}


def read_episodes(path: Path, seeds: range) -> tuple[Row, ...]:
    """The rows of `path`, one for each of `seeds`, in their order.

    Raises UserError naming file and line where a row is cut off, damaged, foreign, repeated or missing.
    """
    if not path.exists():
        raise UserError(f"{path} is missing beside its summary.json: {REMEDY}.")
    rows: dict[int, Row] = {}
    for number, line in enumerate(read_lines(path, REMEDY), 1):
        where = f"{path}, line {number}"
        row = read_row(line, where)
        if row["seed"] not in seeds:
            raise UserError(
                f"{where} is of seed {row['seed']}, but its summary.json covers {seeds[0]} to {seeds[-1]}: {REMEDY}."
            )
        if row["seed"] in rows:
            raise UserError(f"{where} repeats the episode of seed {row['seed']}: {REMEDY}.")
        rows[row["seed"]] = row
    missing = [seed for seed in seeds if seed not in rows]
    if missing:
        raise UserError(
            f"{path} has {len(rows)} of {len(seeds)} episodes: seed {missing[0]} is missing; {REMEDY}."
        )
    return tuple(rows[seed] for seed in seeds)


def read_row(line: str, where: str) -> dict[str, Any]:
    """The row that `line` has. Raises UserError, beginning with `where`, for anything else."""
    if not line.endswith("\n"):
        raise UserError(f"{where} is cut off before its end: {REMEDY}.")
    try:
        row = parse_json(line)
    except ValueError as error:
        raise UserError(f"{where} is not JSON: {error}; {REMEDY}.") from error
    if not isinstance(row, dict):
        raise UserError(f"{where} must be a mapping of keys to values, found {type(row).__name__}; {REMEDY}.")
    for key, (kind, wanted) in SHAPE.items():
        if key not in row:
            raise UserError(f"{where} lacks {key}: {REMEDY}.")
        if not _is(row[key], kind):
            raise UserError(f"{where}: {key} must be {wanted}, found {row[key]!r}; {REMEDY}.")
    stages, timing = row["first_step_of_stage"], row[TIMING]
    if not all(_is(step, int) for step in stages):
        raise UserError(f"{where}: first_step_of_stage must hold whole numbers, found {stages!r}; {REMEDY}.")
    times = timing.get("inference_ms")
    if not (_is(timing.get("wall_s"), float) and _is(times, list) and all(_is(t, float) for t in times)):
        raise UserError(f"{where}: {TIMING} must have wall_s and a list inference_ms of numbers; {REMEDY}.")
    return row


def _is(value: Any, kind: Any) -> bool:
    if kind in (int, float):
        is_number = isinstance(value, int | kind) and not isinstance(value, bool)
        return is_number and abs(value) < math.inf
    return isinstance(value, kind)
