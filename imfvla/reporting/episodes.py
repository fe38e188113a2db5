"""Reads the rows of `episodes.jsonl`, which may be cut off or damaged."""

from array import array
from collections.abc import Sequence
from pathlib import Path
from sys import intern

from imfvla.errors import UserError
from imfvla.reporting.records import Row
from imfvla.storage.documents import parse_json, read_lines
from imfvla.storage.records import as_record

REMEDY = "restore the file or evaluate again with overwrite=true"


def read_episodes(path: Path, seeds: range, home: Path | None = None) -> tuple[Row, ...]:
    """The rows of `path`, a file in the run directory `home`, one for each of `seeds`, in their order.

    Raises UserError naming file and line where a row is cut off, damaged, foreign, repeated or missing.
    """
    return parse_episodes(episode_lines(path, home), path, seeds)


def episode_lines(path: Path, home: Path | None = None) -> list[str]:
    """The text of `path`, by lines. Raises UserError where the file is missing or cannot be read."""
    if not path.exists():
        raise UserError(f"{path} is missing beside its summary.json: {REMEDY}.")
    return read_lines(path, REMEDY, home=home)


def parse_episodes(lines: Sequence[str], path: Path, seeds: range) -> tuple[Row, ...]:
    """The rows that the lines of `path` have, their times as arrays; see `read_episodes`."""
    rows: dict[int, Row] = {}
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        row = read_row(line, where)
        if row["seed"] not in seeds:
            raise UserError(
                f"{where} is of seed {row['seed']}, but its summary.json covers {seeds[0]} to {seeds[-1]}: {REMEDY}."
            )
        if row["seed"] in rows:
            raise UserError(f"{where} repeats the episode of seed {row['seed']}: {REMEDY}.")
        rows[row["seed"]] = _compact(row)
    missing = [seed for seed in seeds if seed not in rows]
    if missing:
        raise UserError(
            f"{path} has {len(rows)} of {len(seeds)} episodes: seed {missing[0]} is missing; {REMEDY}."
        )
    found = tuple(rows[seed] for seed in seeds)
    check_goals(found, str(path))
    return found


def _compact(row: Row) -> Row:
    """An equal row in a third of the memory: names are shared by all rows, digests by all policies, times an array.

    A report has hundreds of thousands of rows with dozens of times each.
    """
    compact = {intern(key): value for key, value in row.items()}
    compact["start_digest"] = intern(row["start_digest"])
    times = array("d", row["timing"]["inference_ms"])
    compact["timing"] = {"wall_s": row["timing"]["wall_s"], "inference_ms": times}
    return compact


def check_goals(rows: Sequence[Row], where: str) -> None:
    """Raises UserError, beginning with `where`, unless all rows or none say which task was asked for."""
    number = sum("goal" in row for row in rows)
    if number not in (0, len(rows)):
        raise UserError(
            f"{where} has a goal in {number} of {len(rows)} rows, wanted in all or in none: {REMEDY}."
        )


def read_row(line: str, where: str) -> Row:
    """The row that `line` has. Raises UserError, beginning with `where`, for anything else."""
    if not line.endswith("\n"):
        raise UserError(f"{where} is cut off before its end: {REMEDY}.")
    try:
        row = parse_json(line)
    except ValueError as error:
        raise UserError(f"{where} is not JSON: {error}; {REMEDY}.") from error
    return as_record(row, Row, where, REMEDY)
