"""Which run answers which row of the paper's tables: `experiments/tables.yaml`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from imfvla.config.assets import folder
from imfvla.errors import UserError
from imfvla.options import Limit, build, one_of, require, suggestion
from imfvla.reporting.mapping_file import entries, load, named, place_of, plain
from imfvla.reporting.mapping_row import TableRow, Wanted
from imfvla.reporting.paper import PaperComparison, paper_comparisons, paper_numbers, paper_rows
from imfvla.reporting.settings import rows_of_settings
from imfvla.storage.run_directory import LAST

PATH = folder("experiments") / "tables.yaml"
OPERATIONS = ("ratio", "inverse_ratio", "difference")
COMPARED = ("avg_return", "success_episodes", "inference_ms_mean", "inference_fps")
ROWS, COMPARISONS, SETTINGS = "rows", "comparisons", "settings"
# of a table's rows
FIGURES = ("reward_latency", "ablations", "success_by_cost", "success_by_delay", "success_by_severity")
SECTIONS = ("evaluation", "tasks", "tables")
PRINTED = Limit("the number of a table in experiments/paper", lambda number: number in paper_numbers())


@dataclass(frozen=True, slots=True)
class TaskTitle:
    """What figures call a task, and its stages where evaluations from before they were recorded do not say them."""

    name: str
    title: str
    stages: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class TableTitle:
    """A table of rows of one task, of `rows` of others in other settings, or of comparisons.

    Comparisons of one table are corrected together. `printed` is its number in the paper, None where the paper has no
    such table; `figure` draws its rows.
    """

    name: str
    title: str
    of: Annotated[str, one_of(ROWS, COMPARISONS, SETTINGS)] = ROWS
    task: str | None = None
    printed: Annotated[int, PRINTED] | None = None
    figure: Annotated[str, one_of(*FIGURES)] | None = None
    rows: tuple[str, ...] = ()
    sweep: str | None = None  # of conf/sweep, which fills the table


@dataclass(frozen=True, slots=True)
class Comparison:
    """A row of comparisons: `of` of a row against that of its baseline, as one of OPERATIONS.

    `paper` is the printed comparison, None where the paper does not have it.
    """

    table: str  # name of its table
    row: TableRow
    baseline: TableRow
    of: str  # one of COMPARED
    operation: str
    paper: PaperComparison | None


@dataclass(frozen=True, slots=True)
class Mapping:
    """All tables, their rows and the comparisons, each in its order; `tasks` have titles."""

    tasks: tuple[TaskTitle, ...]
    tables: tuple[TableTitle, ...]
    rows: tuple[TableRow, ...]
    comparisons: tuple[Comparison, ...]

    @property
    def of_rows(self) -> tuple[TableTitle, ...]:
        return tuple(table for table in self.tables if table.of == ROWS)

    @property
    def of_settings(self) -> tuple[TableTitle, ...]:
        return tuple(table for table in self.tables if table.of == SETTINGS)

    def table(self, name: str) -> TableTitle:
        return next(table for table in self.tables if table.name == name)

    def task(self, name: str) -> TaskTitle:
        """Its title is its name where the file has none."""
        return next((task for task in self.tasks if task.name == name), TaskTitle(name, name))

    def of_table(self, name: str) -> tuple[TableRow, ...]:
        return tuple(row for row in self.rows if row.table == name)

    def of_comparisons(self, name: str) -> tuple[Comparison, ...]:
        return tuple(comparison for comparison in self.comparisons if comparison.table == name)

    def find(self, experiment: str, run: str, nfe: int) -> TableRow | None:
        """The first row of an experiment, a `run_key` and an NFE, whatever its checkpoint."""
        wanted = (experiment, run, nfe)
        usual = (row for row in self.rows if not row.changes)
        return next((row for row in usual if (row.experiment, row.run, row.nfe) == wanted), None)


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


@dataclass(frozen=True, slots=True)
class _ComparisonEntry:
    row: str
    baseline: str
    of: str
    operation: str
    paper: str | None = None


@cache
def read_mapping(path: Path = PATH) -> Mapping:
    """The mapping of a file. Raises UserError naming file, line and row for anything invalid."""
    content = load(path)
    _check_keys(content, path)
    tasks = _titles(content, "tasks", TaskTitle, path)
    tables = _titles(content, "tables", TableTitle, path)
    _check_tables(tables, tasks, path)
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
    comparisons = []
    for table in tables:
        if table.of == COMPARISONS:
            found = [
                _comparison(entry, table, number, path, by_name)
                for number, entry in enumerate(entries(content, table.name, path), 1)
            ]
            if table.printed is not None:
                printed = [comparison.label for comparison in paper_comparisons(table.printed)]
                _check_each_once([c.paper.label for c in found if c.paper], printed, table, path)
            comparisons += found
    return Mapping(tasks, tables, tuple(rows), tuple(comparisons))


def _titles(content: dict[str, Any], key: str, cls: type, path: Path) -> tuple[Any, ...]:
    """The entries of a section, each with the name that it has there."""
    return tuple(
        build(
            cls,
            {"name": name, **plain(entry, f"{path}: {key}.{name}")},
            place_of(entry, f"{key}.{name}", path),
        )
        for name, entry in plain(content[key], f"{path}: {key}").items()
    )


def _check_keys(content: dict[str, Any], path: Path) -> None:
    tables = content.get("tables", {})
    known = {*SECTIONS, *(plain(tables, f"{path}: tables"))}
    for key in content:
        if key not in known:
            raise UserError(
                f"Unknown key {key}{suggestion(key, known)} in {path}; known are {', '.join(sorted(known))}: a table's "
                "rows have the name of one under tables."
            )
    if missing := sorted(known - content.keys()):
        raise UserError(f"{path} lacks {', '.join(missing)}.")


def _check_tables(tables: Sequence[TableTitle], tasks: Sequence[TaskTitle], path: Path) -> None:
    known = {task.name: task for task in tasks}
    for table in tables:
        where = f"{path}: tables.{table.name}"
        if table.of != COMPARISONS:
            require(table.task is not None, f"{where}.task", f"one of {', '.join(known)}", table.task)
            named(table.task, known, f"{where}: unknown task")
            wanted = "the names of rows" if table.of == SETTINGS else "absent but with of: settings"
            require(bool(table.rows) == (table.of == SETTINGS), f"{where}.rows", wanted, list(table.rows))
            if table.of == SETTINGS:
                require(bool(table.sweep), f"{where}.sweep", "the name of a file in conf/sweep", table.sweep)


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


def _comparison(
    entry: dict[str, Any], table: TableTitle, number: int, path: Path, rows: dict[str, TableRow]
) -> Comparison:
    where = place_of(entry, f"{table.name}, row {number}", path)
    values = plain(entry, where)
    if "as" in values:  # a keyword in Python
        values["operation"] = values.pop("as")
    read = build(_ComparisonEntry, values, where)
    require(read.operation in OPERATIONS, f"{where}: as", " or ".join(OPERATIONS), read.operation)
    require(read.of in COMPARED, f"{where}: of", " or ".join(COMPARED), read.of)
    paper = None
    if table.printed is not None or read.paper is not None:
        labels = {} if table.printed is None else {c.label: c for c in paper_comparisons(table.printed)}
        paper = named(read.paper, labels, f"{where}: unknown row of the paper's Table {table.printed}")
    return Comparison(
        table=table.name,
        row=named(read.row, rows, f"{where}: unknown row"),
        baseline=named(read.baseline, rows, f"{where}: unknown row"),
        of=read.of,
        operation=read.operation,
        paper=paper,
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
            _check_each_once(found, printed, table, path)


def _check_each_once(found: Sequence[str], printed: Sequence[str], table: TableTitle, path: Path) -> None:
    for label in printed:
        if found.count(label) != 1:
            raise UserError(
                f"{path}: {table.name} must have the paper's row {label!r} once, found {found.count(label)}."
            )


def _check_checkpoint(checkpoint: str, where: str) -> None:
    is_share = re.fullmatch(r"[1-9]\d*/[1-9]\d*", checkpoint) and 0 < Fraction(checkpoint) <= 1
    require(
        checkpoint == LAST or bool(is_share),
        f"{where}: checkpoint",
        "last or a share such as 1/3",
        checkpoint,
    )
