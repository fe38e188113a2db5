"""Which tables and tasks `experiments/tables.yaml` has: their titles, and what their rows are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from imfvla.errors import UserError
from imfvla.options import Limit, build, one_of, require, suggestion
from imfvla.reporting.mapping.file import named, place_of, plain
from imfvla.reporting.paper import paper_numbers

ROWS, COMPARISONS, SETTINGS, METHODS = "rows", "comparisons", "settings", "methods"
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
    """A table of rows of one task, of `rows` of others in other settings, of comparisons, or of methods by task.

    Comparisons of one table are corrected together. `printed` is its number in the paper, None where the paper has no
    such table; `figure` draws its rows.
    """

    name: str
    title: str
    of: Annotated[str, one_of(ROWS, COMPARISONS, SETTINGS, METHODS)] = ROWS
    task: str | None = None
    printed: Annotated[int, PRINTED] | None = None
    figure: Annotated[str, one_of(*FIGURES)] | None = None
    rows: tuple[str, ...] = ()
    sweep: str | None = None  # of conf/sweep, which fills the table


def read_titles(content: dict[str, Any], path: Path) -> tuple[tuple[TaskTitle, ...], tuple[TableTitle, ...]]:
    """The tasks and tables of a file. Raises UserError naming file and line for a key or title that is wrong."""
    _check_keys(content, path)
    tasks = _titles(content, "tasks", TaskTitle, path)
    tables = _titles(content, "tables", TableTitle, path)
    _check_tables(tables, tasks, path)
    return tasks, tables


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
        if table.of in (ROWS, SETTINGS):
            require(table.task is not None, f"{where}.task", f"one of {', '.join(known)}", table.task)
            named(table.task, known, f"{where}: unknown task")
            wanted = "the names of rows" if table.of == SETTINGS else "absent but with of: settings"
            require(bool(table.rows) == (table.of == SETTINGS), f"{where}.rows", wanted, list(table.rows))
            if table.of == SETTINGS:
                require(bool(table.sweep), f"{where}.sweep", "the name of a file in conf/sweep", table.sweep)


def check_each_once(found: Sequence[str], printed: Sequence[str], table: TableTitle, path: Path) -> None:
    """Raises UserError unless a table has each printed row of the paper's, by label, exactly once."""
    for label in printed:
        if found.count(label) != 1:
            raise UserError(
                f"{path}: {table.name} must have the paper's row {label!r} once, found {found.count(label)}."
            )
