"""Tables 1 to 3 over many runs, ours beside the paper's: Markdown and CSV."""

import logging
from collections.abc import Sequence
from pathlib import Path

from imfvla.files import write_text
from imfvla.reporting.mapping import Comparison, TableRow, read_mapping
from imfvla.reporting.paper import TITLES, PaperRow
from imfvla.reporting.runs import Evaluation, evaluations, rows
from imfvla.reporting.table import NOTHING, Table
from imfvla.reporting.table_row import COLUMNS, ours, printed
from imfvla.run_directory import RunDirectory

Ours = dict[tuple[str, int], Evaluation]  # label and nfe -> the evaluation that stands for it
PRINTED = {  # compared metric -> field of a printed row
    "avg_return": "avg_reward",
    "success_episodes": "success",
    "inference_ms_mean": "latency_ms",
    "inference_fps": "inference_fps",
}
log = logging.getLogger(__name__)


def collect(runs: Sequence[RunDirectory]) -> Ours:
    """The evaluation of each experiment and nfe in the reporting band; of several runs, that of the last one."""
    found: Ours = {}
    for run in runs:
        for evaluation in rows(run) if evaluations(run) else []:
            if not evaluation.is_reporting:
                log.info("%s is left out: no whole episodes of the reporting band.", evaluation.folder)
                continue
            found[label(evaluation), evaluation.nfe] = evaluation
    return found


def label(evaluation: Evaluation) -> str:
    """The experiment, with the overrides in the run's name if any: such runs stand for no row of the paper."""
    experiment, name = evaluation.summary["experiment"], evaluation.run.resolve().name
    return experiment if name in ("default", experiment) else f"{experiment}/{name}"


def tables(found: Ours) -> dict[str, Table]:
    """File stem -> table: the paper's three, and the rows of ours that the paper does not have."""
    named = {f"table{number}": _paper_table(number, found) for number in (1, 2)}
    named["table3"] = _comparison_table(found)
    known = {_key(row) for row in read_mapping().rows}
    others = {key: evaluation for key, evaluation in found.items() if key not in known}
    if others:
        cells = tuple(
            (experiment, str(nfe), "ours", *ours(evaluation.summary))
            for (experiment, nfe), evaluation in sorted(others.items())
        )
        named["others"] = Table("Rows without a counterpart in the paper", ("Experiment", *COLUMNS), cells)
    return named


def write(named: dict[str, Table], directory: Path) -> list[Path]:
    """Writes each table as Markdown and CSV; returns the paths."""
    paths = []
    for stem, table in named.items():
        for suffix, text in ((".md", table.markdown()), (".csv", table.csv())):
            write_text(directory / f"{stem}{suffix}", text)
            paths.append(directory / f"{stem}{suffix}")
    return paths


def derived(comparison: Comparison, row: PaperRow, baseline: PaperRow) -> str:
    """A result of Table 3 from two printed rows, as the paper prints it: "1.76×" or "+15"."""
    column = PRINTED[comparison.of]
    return _result(comparison.operation, getattr(row, column), getattr(baseline, column))


def _key(row: TableRow) -> tuple[str, int]:
    return (f"{row.experiment}/{row.run}" if row.run else row.experiment), row.nfe


def _paper_table(number: int, found: Ours) -> Table:
    cells = []
    for row in read_mapping().of_table(number):
        if row.paper:
            cells.append((row.label, str(row.nfe), "paper", *printed(row.paper)))
        if _key(row) in found:
            cells.append((row.experiment, str(row.nfe), "ours", *ours(found[_key(row)].summary)))
    note = "Our rows stand below the paper's of the same experiment; where none stands, it has not been run here."
    return Table(TITLES[number], ("Experiment", *COLUMNS), tuple(cells), (note,))


def _comparison_table(found: Ours) -> Table:
    cells = []
    for comparison in read_mapping().comparisons:
        row, baseline = found.get(_key(comparison.row)), found.get(_key(comparison.baseline))
        result = NOTHING
        if row and baseline and row.summary["episodes"] == baseline.summary["episodes"]:
            result = _result(
                comparison.operation, row.summary[comparison.of], baseline.summary[comparison.of]
            )
        paper = comparison.paper
        cells.append((paper.comparison, paper.metric, paper.result, result))
    return Table(TITLES[3], ("Comparison", "Metric", "Paper", "Ours"), tuple(cells))


def _result(operation: str, value: float | None, against: float | None) -> str:
    if value is None or against is None:
        return NOTHING
    if operation == "difference":
        return f"{value - against:+g}"
    if operation == "inverse_ratio":
        value, against = against, value
    return f"{value / against:.2f}×" if against else NOTHING
