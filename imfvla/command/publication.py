"""The results of run directories as files: tables, figures and a page. Needs neither torch nor mujoco."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.figures.ablations import ablations
from imfvla.figures.components import method_components
from imfvla.figures.depth_attention import depth_attention, read_depth_attention
from imfvla.figures.evaluations import success_by_evaluations
from imfvla.figures.failures import failed_stages
from imfvla.figures.learning import learning_curves
from imfvla.figures.methods import success_by_cost
from imfvla.figures.overview import method_overview
from imfvla.figures.reward_latency import reward_latency
from imfvla.figures.settings import success_by_delay, success_by_severity
from imfvla.figures.style import render
from imfvla.process.progress import Progress
from imfvla.reporting.answers import Sources, check_equal_protocols
from imfvla.reporting.comparisons import compare
from imfvla.reporting.mapping import Mapping as RowMapping
from imfvla.reporting.mapping.tables import COMPARISONS, METHODS, SETTINGS, TableTitle
from imfvla.reporting.media import Media
from imfvla.reporting.methods_table import methods_table
from imfvla.reporting.offline import read_offline
from imfvla.reporting.offline_tables import offline_table
from imfvla.reporting.page import Picture, page
from imfvla.reporting.published import published_rows
from imfvla.reporting.results import Result
from imfvla.reporting.runs import find_runs, key_of
from imfvla.reporting.settings_table import settings_table, unchanged_rows
from imfvla.reporting.table import Table
from imfvla.reporting.tables import Document, comparison_table, other_table, row_table
from imfvla.storage.files import write_together

MAX_HEAT_MAPS = 4
OF_TABLE = {  # by `figure` of a table: what draws its rows, and what that shows
    "reward_latency": (reward_latency, "average reward against the time of a chunk."),
    "ablations": (ablations, "ablations and rivals."),
    "success_by_delay": (
        success_by_delay,
        "success against the delay of a chunk on a running clock.",
    ),
    "success_by_severity": (
        success_by_severity,
        "success against the severity of each condition.",
    ),
    "success_by_cost": (success_by_cost, "success against the network calls and the time of a chunk."),
}


@dataclass(frozen=True, slots=True)
class Publication:
    """Tables for the terminal, and the content of every file by its path."""

    tables: tuple[Table, ...]
    files: dict[Path, bytes]
    copies: dict[
        Path, tuple[Path, Path]
    ]  # of files of runs that the page shows: copy -> original, run directory
    # a line for each table without any measured row; their files are written too
    left_out: tuple[str, ...] = ()

    def write(self) -> list[Path]:
        """All files or none, after the copies. Raises UserError on a write error."""
        write_together(self.files, self.copies)
        return list(self.files)


def publish(
    directories: Sequence[Path],
    output: Path,
    mapping: RowMapping,
    method: Mapping[str, Any],
    *,
    media: bool = False,
) -> Publication:
    """The results in the run directories, as files for `output`; writes nothing.

    Args:
      directories: hold run directories; for each row, a later run takes precedence over an earlier one.
      output: directory of the files; the page's links to runs are relative to it.
      mapping: rows to runs.
      method: a composed training config, for the figures of the method.
      media: whether videos, recordings and other files of the runs are copied beside the page, so that it can be moved.

    Raises:
      UserError: runs are damaged, contradict each other or mix protocols; or none of their rows is in any table.
    """
    sources = Sources(directories)
    answers = [sources.answer(row, mapping) for row in mapping.rows]
    for table in (*mapping.of_rows, *mapping.of_settings):
        check_equal_protocols([answer for answer in answers if answer.row.table == table.name], table.task)
    results = [Result.of(answer) for answer in answers]
    others = [Result(found) for found in sources.others(answers)]
    offline = _offline(directories)
    if all(result.is_missing for result in results) and not others and not offline:
        raise UserError(
            f"No run with a finished evaluation below {', '.join(map(str, directories))}: make one with "
            "python -m imfvla.train +exp=socket_ph32_exec16, or name directories=[...]."
        )
    measured = [table for table in mapping.tables if _is_measured(table, mapping, results)]
    left_out = [table for table in mapping.tables if table not in measured]
    documents = {}
    with Progress("tables", len(mapping.tables)) as bar:
        for table in mapping.tables:
            documents[table.name] = _document(table, mapping, results)
            bar.advance(table.name)
    documents["others"] = other_table(others)
    if offline:
        documents["offline"] = offline_table(offline)
    figures = _figures(mapping, measured, results, others, method)
    pictures = [Picture(name, caption, files[".svg"]) for name, (caption, files) in figures.items()]
    hidden = {table.name for table in left_out}
    tables = tuple(document.shown for name, document in documents.items() if name not in hidden)
    linked = Media(output, is_copied=media)
    files = {output / "index.html": page(tables, pictures, [*results, *others], linked).encode()}
    for stem, document in documents.items():
        files |= {output / f"{stem}{suffix}": text.encode() for suffix, text in _formats(document).items()}
    for name, (_, rendered) in figures.items():
        files |= {output / "figures" / f"{name}{suffix}": content for suffix, content in rendered.items()}
    return Publication(tables, files, linked.copies, tuple(map(_not_measured, left_out)))


def _offline(directories: Sequence[Path]) -> list[tuple[str, dict[str, Any]]]:
    """Name and numbers of every run that was evaluated without an environment."""
    found = []
    for run in find_runs(directories):
        if (numbers := read_offline(run)) is not None:
            key = key_of(run.path, numbers["experiment"])
            found.append((f"{numbers['experiment']}/{key}" if key else numbers["experiment"], numbers))
    return found


def _formats(document: Document) -> dict[str, str]:
    return {".md": document.shown.markdown(), ".csv": document.data.csv(), ".tex": document.shown.latex()}


def _is_measured(table: TableTitle, mapping: RowMapping, results: Sequence[Result]) -> bool:
    """Whether any row of the table has a run."""
    found = {result.name: result for result in results if not result.is_missing}
    if table.of == COMPARISONS:
        compared = mapping.of_comparisons(table.name)
        return any({one.row.name, one.baseline.name} <= found.keys() for one in compared)
    if table.of == METHODS:
        return any(
            row.name in found for entry in mapping.of_methods(table.name) for row in entry.rows.values()
        )
    return any(result.row.table == table.name for result in found.values())


def _not_measured(table: TableTitle) -> str:
    command = f"; fill it with python -m imfvla.train -m +sweep={table.sweep}" if table.sweep else ""
    return f"{table.title}: no row measured yet{command}"


def _document(table: TableTitle, mapping: RowMapping, results: Sequence[Result]) -> Document:
    if table.of == COMPARISONS:
        return comparison_table(table.title, compare(mapping.of_comparisons(table.name), results))
    if table.of == SETTINGS:
        return settings_table(table, results)
    if table.of == METHODS:
        return methods_table(table, mapping.of_methods(table.name), mapping.of_rows, results)
    rows = [result for result in results if result.row.table == table.name]
    return row_table(table.title, rows, published=published_rows(table.task))


def _figures(
    mapping: RowMapping,
    measured: Sequence[TableTitle],
    results: Sequence[Result],
    others: Sequence[Result],
    method: Mapping[str, Any],
) -> dict[str, tuple[str, dict[str, bytes]]]:
    """Caption and files of each figure, by name; without those of tables that have no `measured` row."""
    settings = {
        table: [*unchanged_rows(table, results).values(), *(r for r in results if r.row.table == table.name)]
        for table in mapping.of_settings
    }
    results = [result for result in results if not result.row.changes]
    every = [*results, *others]
    drawn = {
        "figure1_overview": (
            method_overview(method),
            f"Figure 1. The method, as {method['name']} is configured.",
        ),
        "figure2_components": (
            method_components(method),
            f"Figure 2. What the generator of {method['name']} learns, and what its sublayers read.",
        ),
    }
    numbers = {table: number for number, table in enumerate(filter(lambda t: t.printed, mapping.of_rows), 3)}
    for table in measured:
        if table.figure is None:
            continue
        draw, shows = OF_TABLE[table.figure]
        rows = settings.get(table) or [result for result in results if result.row.table == table.name]
        if number := numbers.get(table):
            title = mapping.task(table.task).title
            name, title = f"figure{number}_{table.figure}", f"Figure {number}. {title[:1].upper()}{title[1:]}"
        else:
            name, title = f"{table.figure}_{table.name}", table.title
        drawn[name] = (draw(rows), f"{title}: {shows} Bars are 95% intervals.")
    drawn |= {
        "evaluations": (
            success_by_evaluations(every),
            "Success-like episodes against the number of network calls for a chunk. Bars are Wilson's 95% intervals.",
        ),
        "learning": (
            learning_curves(every),
            "Training loss of every run above, a panel for each kind of loss: numbers of different panels are in "
            "different units.",
        ),
        "failures": (
            failed_stages(results),
            "Where episodes of the tables' rows fail: the first stage that was not reached.",
        ),
        "failures_others": (
            failed_stages(others),
            "Where episodes of evaluations in no row fail: the first stage that was not reached.",
        ),
        "depth_attention": (
            depth_attention(_depth_attention(every)),
            "What the sublayers of trained policies read: mean Attention Residual weights over the action tokens.",
        ),
    }
    rendered = {}
    with Progress("figures", len(drawn)) as bar:
        for name, (figure, caption) in drawn.items():
            rendered[name] = (caption, render(figure))
            bar.advance(name)
    return rendered


def _depth_attention(results: Sequence[Result]) -> list[dict[str, Any]]:
    runs = {found.evaluation.run: found.evaluation.config for result in results for found in result.evaluated}
    recorded = (read_depth_attention(run, config.get("core")) for run, config in runs.items())
    return [found for found in recorded if found is not None][:MAX_HEAT_MAPS]
