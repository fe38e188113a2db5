"""Reads `metrics.jsonl`, which a kill may have cut off."""

from pathlib import Path

from imfvla.errors import UserError
from imfvla.storage.documents import parse_json, read_lines
from imfvla.storage.records import Metrics, MetricsRow, as_record

REMEDY = "restore or delete the file"


def read_metrics(path: Path) -> list[MetricsRow]:
    """The rows, without a last line that a kill cut off; none where there is no file.

    Raises UserError naming file and line where another line is damaged.
    """
    if not path.exists():
        return []
    rows = []
    lines = read_lines(path, REMEDY)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        try:
            row = parse_json(line)
        except ValueError as error:
            raise UserError(f"{where} is not JSON: {error}; {REMEDY}.") from error
        rows.append(as_record(as_record(row, Metrics, where, REMEDY), MetricsRow, where, REMEDY))
    return rows
