"""Which run answers which row of the paper's tables: `experiments/tables.yaml`."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from imfvla.config.assets import folder
from imfvla.reporting.mapping.comparisons import Comparison, read_comparisons
from imfvla.reporting.mapping.file import load
from imfvla.reporting.mapping.methods import MethodEntry, read_methods
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.mapping.rows import read_rows
from imfvla.reporting.mapping.tables import ROWS, SETTINGS, TableTitle, TaskTitle, read_titles

PATH = folder("experiments") / "tables.yaml"


@dataclass(frozen=True, slots=True)
class Mapping:
    """All tables, their rows, comparisons and methods, each in its order; `tasks` have titles."""

    tasks: tuple[TaskTitle, ...]
    tables: tuple[TableTitle, ...]
    rows: tuple[TableRow, ...]
    comparisons: tuple[Comparison, ...]
    methods: tuple[MethodEntry, ...] = ()

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

    def of_methods(self, name: str) -> tuple[MethodEntry, ...]:
        return tuple(method for method in self.methods if method.table == name)

    def find(self, experiment: str, run: str, nfe: int) -> TableRow | None:
        """The first row of an experiment, a `run_key` and an NFE, whatever its checkpoint."""
        wanted = (experiment, run, nfe)
        usual = (row for row in self.rows if not row.changes)
        return next((row for row in usual if (row.experiment, row.run, row.nfe) == wanted), None)


@cache
def read_mapping(path: Path = PATH) -> Mapping:
    """The mapping of a file. Raises UserError naming file, line and row for anything invalid."""
    content = load(path)
    tasks, tables = read_titles(content, path)
    rows = read_rows(content, tables, path)
    comparisons = read_comparisons(content, tables, rows, path)
    return Mapping(tasks, tables, rows, comparisons, read_methods(content, tables, rows, path))
