"""Which rows of the tables are compared: the comparisons of `experiments/tables.yaml`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.options import DIFFERENT, build, require, within_length
from imfvla.reporting.mapping.file import entries, named, place_of, plain
from imfvla.reporting.mapping.row import TableRow, row_named
from imfvla.reporting.mapping.tables import COMPARISONS, TableTitle, check_each_once
from imfvla.reporting.paper import PaperComparison, paper_comparisons

OPERATIONS = ("ratio", "inverse_ratio", "difference")
COMPARED = ("avg_return", "success_episodes", "inference_ms_mean", "inference_fps")


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
class _ComparisonEntry:
    row: str
    baseline: Annotated[tuple[str, ...], DIFFERENT, within_length(1, 100)]
    of: str
    operation: str
    paper: str | None = None


def read_comparisons(
    content: dict[str, Any], tables: Sequence[TableTitle], rows: Sequence[TableRow], path: Path
) -> tuple[Comparison, ...]:
    """Those of all tables of comparisons, of `rows`, which may be those of settings.

    Raises UserError naming file, line and row for a wrong one.
    """
    by_name = {row.name: row for row in rows}
    comparisons: list[Comparison] = []
    for table in tables:
        if table.of == COMPARISONS:
            found = [
                comparison
                for number, entry in enumerate(entries(content, table.name, path), 1)
                for comparison in _comparisons(entry, table, number, path, by_name)
            ]
            if table.printed is not None:
                printed = [comparison.label for comparison in paper_comparisons(table.printed)]
                check_each_once([c.paper.label for c in found if c.paper], printed, table, path)
            comparisons += found
    return tuple(comparisons)


def _comparisons(
    entry: dict[str, Any], table: TableTitle, number: int, path: Path, rows: dict[str, TableRow]
) -> list[Comparison]:
    """One for each baseline of an entry."""
    where = place_of(entry, f"{table.name}, row {number}", path)
    values = plain(entry, where)
    if "as" in values:  # a keyword in Python
        values["operation"] = values.pop("as")
    if isinstance(values.get("baseline"), str):
        values["baseline"] = [values["baseline"]]
    read = build(_ComparisonEntry, values, where)
    require(read.operation in OPERATIONS, f"{where}: as", " or ".join(OPERATIONS), read.operation)
    require(read.of in COMPARED, f"{where}: of", " or ".join(COMPARED), read.of)
    paper = None
    if table.printed is not None or read.paper is not None:
        labels = {} if table.printed is None else {c.label: c for c in paper_comparisons(table.printed)}
        paper = named(read.paper, labels, f"{where}: unknown row of the paper's Table {table.printed}")
    return [
        Comparison(
            table=table.name,
            row=row_named(read.row, rows, where),
            baseline=row_named(baseline, rows, where),
            of=read.of,
            operation=read.operation,
            paper=paper,
        )
        for baseline in read.baseline
    ]
