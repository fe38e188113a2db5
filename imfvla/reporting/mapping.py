"""Which run answers which row of the paper's tables: `experiments/tables.yaml`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from imfvla.assets import folder
from imfvla.documents import ChosenLoader, read_yaml
from imfvla.errors import UserError
from imfvla.options import build, require, suggestion
from imfvla.reporting.paper import (
    TABLES,
    PaperComparison,
    PaperRow,
    paper_comparisons,
    paper_rows,
)
from imfvla.run_directory import LAST, step_of
from imfvla.run_names import run_key, run_name

PATH = folder("experiments") / "tables.yaml"
OPERATIONS = ("ratio", "inverse_ratio", "difference")
COMPARED = ("avg_return", "success_episodes", "inference_ms_mean", "inference_fps")
_LINE = "__line__"


@dataclass(frozen=True, slots=True)
class Wanted:
    """The evaluation that a row is taken from: whole episodes from consecutive seeds."""

    first_seed: int
    episodes: int
    noise_seed: int
    device: str


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row of Table 1 or 2. `paper` is the printed row, None for a rival that the paper does not have."""

    name: str
    table: int
    experiment: str  # of conf/exp
    overrides: tuple[str, ...]
    nfe: int
    checkpoint: str  # "last", or a share such as "1/3" of the training steps
    wanted: Wanted
    method: str
    setting: str
    paper: PaperRow | None
    where: str  # file and line, for messages

    @property
    def run(self) -> str:
        """Name of the run directory below that of the experiment, its seed apart; "" for "default"."""
        return run_key(run_name(self.overrides))

    @property
    def label(self) -> str:
        return f"{self.method} ({self.setting})"

    def step(self, steps: int) -> int:
        """The step of the row's weights in a training of so many steps."""
        return step_of(steps, self.checkpoint)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A row of Table 3: `of` of a row against that of its baseline, as one of OPERATIONS."""

    row: TableRow
    baseline: TableRow
    of: str  # one of COMPARED
    operation: str
    paper: PaperComparison


@dataclass(frozen=True, slots=True)
class Mapping:
    """The rows of Tables 1 and 2 and the comparisons of Table 3, each in its order."""

    rows: tuple[TableRow, ...]
    comparisons: tuple[Comparison, ...]

    def of_table(self, table: int) -> tuple[TableRow, ...]:
        return tuple(row for row in self.rows if row.table == table)

    def find(self, experiment: str, run: str, nfe: int) -> TableRow | None:
        """The first row of an experiment, a `run_key` and an NFE, whatever its checkpoint."""
        wanted = (experiment, run, nfe)
        return next((row for row in self.rows if (row.experiment, row.run, row.nfe) == wanted), None)


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
    paper: str
    row: str
    baseline: str
    of: str
    operation: str


@cache
def read_mapping(path: Path = PATH) -> Mapping:
    """The mapping of a file. Raises UserError naming file, line and row for anything invalid."""
    content = _load(path)
    known = {"evaluation", *(f"table{number}" for number in (*TABLES, 3))}
    for key in content:
        if key not in known:
            raise UserError(
                f"Unknown key {key}{suggestion(key, known)} in {path}; known are {', '.join(sorted(known))}."
            )
    missing = sorted(known - content.keys())
    if missing:
        raise UserError(f"{path} lacks {', '.join(missing)}.")
    evaluation = _plain(content["evaluation"], f"{path}: evaluation")
    wanted = build(Wanted, evaluation, f"{path}: evaluation")
    rows = [
        _row(entry, table, number, path, wanted)
        for table in TABLES
        for number, entry in enumerate(_entries(content, f"table{table}", path), 1)
    ]
    _check_rows(rows, path)
    names = {row.name: row for row in rows}
    comparisons = [
        _comparison(entry, number, path, names)
        for number, entry in enumerate(_entries(content, "table3", path), 1)
    ]
    _check_each_once([c.paper.label for c in comparisons], [p.label for p in paper_comparisons()], 3, path)
    return Mapping(tuple(rows), tuple(comparisons))


def _row(entry: dict[str, Any], table: int, number: int, path: Path, default: Wanted) -> TableRow:
    where = _where(entry, f"table{table}, row {number}", path)
    values = _plain(entry, where)
    wanted = replace(default)
    if "evaluation" in values:
        changes = _plain(values.pop("evaluation"), f"{where}: evaluation")
        base = {name: getattr(default, name) for name in Wanted.__slots__}
        wanted = build(Wanted, base | changes, f"{where}: evaluation")
    read = build(_RowEntry, values, where)
    require(read.nfe >= 1, f"{where}: nfe", "at least 1", read.nfe)
    _check_checkpoint(read.checkpoint, where)
    paper = None
    if read.paper is not None:
        if read.method is not None or read.setting is not None:
            raise UserError(f"{where} has both paper and method or setting: give one or the other.")
        labels = {row.label: row for row in paper_rows() if row.table == table}
        paper = _named(read.paper, labels, f"{where}: unknown row of the paper's Table {table}")
    elif read.method is None or read.setting is None:
        raise UserError(f"{where} must have paper, or method and setting, to say what the row is.")
    return TableRow(
        name=read.name,
        table=table,
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


def _comparison(entry: dict[str, Any], number: int, path: Path, rows: dict[str, TableRow]) -> Comparison:
    where = _where(entry, f"table3, row {number}", path)
    values = _plain(entry, where)
    if "as" in values:  # a keyword in Python
        values["operation"] = values.pop("as")
    read = build(_ComparisonEntry, values, where)
    require(read.operation in OPERATIONS, f"{where}: as", " or ".join(OPERATIONS), read.operation)
    require(read.of in COMPARED, f"{where}: of", " or ".join(COMPARED), read.of)
    printed = {comparison.label: comparison for comparison in paper_comparisons()}
    return Comparison(
        row=_named(read.row, rows, f"{where}: unknown row"),
        baseline=_named(read.baseline, rows, f"{where}: unknown row"),
        of=read.of,
        operation=read.operation,
        paper=_named(read.paper, printed, f"{where}: unknown row of the paper's Table 3"),
    )


def _check_rows(rows: Sequence[TableRow], path: Path) -> None:
    seen: dict[str, TableRow] = {}
    for row in rows:
        if row.name in seen:
            raise UserError(f"{row.where}: the name {row.name} is taken by {seen[row.name].where}.")
        seen[row.name] = row
    for table in TABLES:
        printed = [paper.label for paper in paper_rows() if paper.table == table]
        found = [row.paper.label for row in rows if row.paper and row.table == table]
        _check_each_once(found, printed, table, path)


def _check_each_once(found: Sequence[str], printed: Sequence[str], table: int, path: Path) -> None:
    for label in printed:
        if found.count(label) != 1:
            raise UserError(
                f"{path}: table{table} must have the paper's row {label!r} once, found {found.count(label)}."
            )


def _check_checkpoint(checkpoint: str, where: str) -> None:
    is_share = re.fullmatch(r"[1-9]\d*/[1-9]\d*", checkpoint) and 0 < Fraction(checkpoint) <= 1
    require(
        checkpoint == LAST or bool(is_share),
        f"{where}: checkpoint",
        "last or a share such as 1/3",
        checkpoint,
    )


def _named(name: str, known: dict[str, Any], problem: str) -> Any:
    if name not in known:
        raise UserError(f"{problem} {name!r}{suggestion(name, known)}; known are {', '.join(known)}.")
    return known[name]


def _where(entry: Any, what: str, path: Path) -> str:
    line = entry.get(_LINE) if isinstance(entry, dict) else None
    return f"{path}, line {line}, {what}" if line else f"{path}, {what}"


def _plain(entry: Any, where: str) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise UserError(f"{where} must be a mapping of keys to values, found {entry!r}.")
    return {key: value for key, value in entry.items() if key != _LINE}


def _entries(content: dict[str, Any], key: str, path: Path) -> list[Any]:
    if not isinstance(content[key], list):
        raise UserError(f"{path}: {key} must be a list of rows, found {content[key]!r}.")
    return content[key]


class _Loader(ChosenLoader):
    """Notes for each mapping the line where it begins, and refuses a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        line = node.start_mark.line + 1
        keys = [key.value for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"line {line} has {twice} twice", None)
        return super().construct_mapping(node, deep=True) | {_LINE: line}


_Loader.add_constructor("tag:yaml.org,2002:map", lambda loader, node: loader.construct_mapping(node))


def _load(path: Path) -> dict[str, Any]:
    try:
        content = read_yaml(path, _Loader)
    except OSError as error:
        raise UserError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error
    return _plain(content, str(path))
