"""Which rows stand for a method on each task: the tables of methods of `experiments/tables.yaml`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.options import DIFFERENT, build, require, within_length
from imfvla.reporting.mapping.file import entries, place_of, plain
from imfvla.reporting.mapping.row import TableRow, row_named
from imfvla.reporting.mapping.tables import METHODS, TableTitle


@dataclass(frozen=True, slots=True)
class MethodEntry:
    """A line of a table of methods."""

    table: str  # name of its table
    method: str
    rows: Mapping[str, TableRow]  # by the name of a table of rows, its row there, as it is or in a setting


@dataclass(frozen=True, slots=True)
class _Entry:
    method: Annotated[str, within_length(1, 100)]
    rows: Annotated[tuple[str, ...], DIFFERENT]


def read_methods(
    content: dict[str, Any], tables: Sequence[TableTitle], rows: Sequence[TableRow], path: Path
) -> tuple[MethodEntry, ...]:
    """Those of all tables of methods. Raises UserError naming file, line and row for a wrong one."""
    by_name = {row.name: row for row in rows}
    return tuple(
        _method(entry, table, number, path, by_name)
        for table in tables
        if table.of == METHODS
        for number, entry in enumerate(entries(content, table.name, path), 1)
    )


def _method(entry: Any, table: TableTitle, number: int, path: Path, rows: dict[str, TableRow]) -> MethodEntry:
    where = place_of(entry, f"{table.name}, row {number}", path)
    read = build(_Entry, plain(entry, where), where)
    found = [row_named(name, rows, where) for name in read.rows]
    of_each = {(rows[row.base] if row.base else row).table: row for row in found}
    require(
        0 < len(of_each) == len(found), f"{where}: rows", "one row of each table at most", list(read.rows)
    )
    return MethodEntry(table.name, read.method, of_each)
