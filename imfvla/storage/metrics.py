"""Reads `metrics.jsonl`, which a kill may have cut off."""

from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.options import MAX_TEXT
from imfvla.storage.documents import parse_json, read_lines
from imfvla.storage.records import MAX_STEPS, MOST_METRICS, Metrics, MetricsRow, as_record

REMEDY = "restore or delete the file"
MOST_PARTS = 8_000_000  # of all rows together, which are read faster than those of other files
LARGEST = 1e308  # of a whole number: below the largest float


def read_metrics(path: Path) -> list[MetricsRow]:
    """The rows, without a last line that a kill cut off; none where there is no file.

    Raises UserError naming file and line where another line is damaged.
    """
    if not path.exists():
        return []
    rows = []
    lines = read_lines(path, REMEDY, most_parts=MOST_PARTS)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        try:
            row = parse_json(line)
        except ValueError as error:
            raise UserError(f"{where} is not JSON: {error}; {REMEDY}.") from error
        # A training may have a million rows, and `as_record` takes ten times longer than reading one.
        if not _is_row(row):
            row = as_record(as_record(row, Metrics, where, REMEDY), MetricsRow, where, REMEDY)
        rows.append(row)
    return rows


def _is_row(row: Any) -> bool:
    """Whether it is a row without a doubt, as `MetricsRow` and `Metrics` say."""
    if type(row) is not dict or len(row) > MOST_METRICS or type(step := row.get("step")) is not int:
        return False
    return 0 <= step <= MAX_STEPS and all(map(_is_number, row.values())) and max(map(len, row)) <= MAX_TEXT


def _is_number(value: Any) -> bool:
    kind = value.__class__
    return kind is float or value is None or (kind is int and -LARGEST <= value <= LARGEST)
