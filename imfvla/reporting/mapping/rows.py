"""Reads the rows of the tables of `experiments/tables.yaml`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.options import build, require
from imfvla.reporting.mapping.file import entries, named, place_of, plain
from imfvla.reporting.mapping.row import TableRow, Wanted
from imfvla.reporting.mapping.settings import rows_of_settings
from imfvla.reporting.mapping.tables import ROWS, SETTINGS, TableTitle, check_each_once
from imfvla.reporting.paper import paper_rows
from imfvla.storage.run_directory import LAST


@dataclass(frozen=True, slots=True)
class _RowEntry:
    name: str
    experiment: str
    nfe: int
    paper: str | None = None
    method: str | None = None
    setting: str | None = None
    overrides: tuple[str, ...] = ()
    checkpoint: str = LAST


def read_rows(content: dict[str, Any], tables: Sequence[TableTitle], path: Path) -> tuple[TableRow, ...]:
    """The rows of all tables, those of settings last. Raises UserError naming file, line and row for a wrong one."""
    evaluation = plain(content["evaluation"], f"{path}: evaluation")
    wanted = build(Wanted, evaluation, f"{path}: evaluation")
    rows = [
        _row(entry, table, number, path, wanted)
        for table in tables
        if table.of == ROWS
        for number, entry in enumerate(entries(content, table.name, path), 1)
    ]
    by_name = {row.name: row for row in rows}
    for table in tables:
        if table.of == SETTINGS:
            rows += rows_of_settings(
                entries(content, table.name, path), table.name, table.rows, by_name, path
            )
    _check_rows(rows, tables, path)
    return tuple(rows)


def _row(entry: dict[str, Any], table: TableTitle, number: int, path: Path, default: Wanted) -> TableRow:
    where = place_of(entry, f"{table.name}, row {number}", path)
    values = plain(entry, where)
    wanted = replace(default)
    if "evaluation" in values:
        changes = plain(values.pop("evaluation"), f"{where}: evaluation")
        base = {name: getattr(default, name) for name in Wanted.__slots__}
        wanted = build(Wanted, base | changes, f"{where}: evaluation")
    read = build(_RowEntry, values, where)
    require(read.nfe >= 1, f"{where}: nfe", "at least 1", read.nfe)
    _check_checkpoint(read.checkpoint, where)
    paper = None
    if read.paper is not None:
        if read.method is not None or read.setting is not None:
            raise UserError(f"{where} has both paper and method or setting: give one or the other.")
        labels = {} if table.printed is None else {row.label: row for row in paper_rows(table.printed)}
        paper = named(read.paper, labels, f"{where}: unknown row of the paper's Table {table.printed}")
    elif read.method is None or read.setting is None:
        raise UserError(f"{where} must have paper, or method and setting, to say what the row is.")
    return TableRow(
        name=read.name,
        table=table.name,
        experiment=read.experiment,
        overrides=read.overrides,
        nfe=read.nfe,
        checkpoint=read.checkpoint,
        wanted=wanted,
        method=paper.method if paper else read.method,
        setting=paper.setting if paper else read.setting,
        paper=paper,
        where=where,
    )


def _check_rows(rows: Sequence[TableRow], tables: Sequence[TableTitle], path: Path) -> None:
    seen: dict[str, TableRow] = {}
    for row in rows:
        if row.name in seen:
            raise UserError(f"{row.where}: the name {row.name} is taken by {seen[row.name].where}.")
        seen[row.name] = row
    for table in tables:
        if table.of == ROWS and table.printed is not None:
            printed = [paper.label for paper in paper_rows(table.printed)]
            found = [row.paper.label for row in rows if row.paper and row.table == table.name]
            check_each_once(found, printed, table, path)


def _check_checkpoint(checkpoint: str, where: str) -> None:
    is_share = re.fullmatch(r"[1-9]\d*/[1-9]\d*", checkpoint) and 0 < Fraction(checkpoint) <= 1
    require(
        checkpoint == LAST or bool(is_share),
        f"{where}: checkpoint",
        "last or a share such as 1/3",
        checkpoint,
    )
