"""The row of a run beside the paper's printed one: for the terminal, `table_row.md` and `table_row.json`."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console

from imfvla.reporting.cells import SHOWN, TITLES, alone, printed
from imfvla.reporting.metrics import METRICS
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.runs import Evaluation, evaluations, rows
from imfvla.reporting.statistics.estimates import wilson_interval
from imfvla.reporting.table import Table
from imfvla.storage.files import write_json, write_text
from imfvla.storage.run_directory import LAST, RunDirectory

BEHIND = [metric.name for metric in SHOWN].index("success_episodes") + 1  # where its interval has a column
IN_JSON = ("episodes", *(metric.name for metric in METRICS), "success_interval", "failures", "latency_alone")
COLUMNS = ("nfe", "source", *TITLES[:BEHIND], "95% interval", *TITLES[BEHIND:])


def print_row(run: RunDirectory, console: Console | None = None, *, only: Collection[str] = ()) -> None:
    """Prints the rows of a run, one for each nfe, and writes `table_row.md` and `table_row.json` beside its config.

    With `only`, folder names in `rollouts/`, prints those evaluations; the files always hold the rows that represent
    the run. Raises UserError where the run has no finished evaluation.
    """
    found = rows(run)
    write_text(run.path / "table_row.md", table_of(found).markdown())
    write_json(run.path / "table_row.json", [as_json(evaluation) for evaluation in found])
    chosen = [evaluation for evaluation in evaluations(run) if evaluation.folder.name in only]
    table_of(sorted(chosen, key=lambda evaluation: evaluation.nfe) or found).print(console)


def table_of(found: Sequence[Evaluation]) -> Table:
    """Ours and the paper's rows of one run, in turn."""
    summary, papers = found[0].summary, [paper_of(evaluation) for evaluation in found]
    where = next((f"Table {paper.table}" for paper in papers if paper), "no row in the paper")
    cells = []
    for evaluation, paper in zip(found, papers, strict=True):
        cells.append((str(evaluation.nfe), "ours", *ours(evaluation.summary)))
        if paper is not None:
            cells.append((str(evaluation.nfe), "paper", *of_paper(paper)))
    note = (
        f"Seeds {summary['seeds'][0]} to {summary['seeds'][1]}, weights of step {summary['checkpoint_step']}, "
        f"{summary['protocol']['task']} ({summary['protocol']['variant']}); {machine(summary)}. "
        "Interval: Wilson, of the success share. Latency: mean over all replannings, numpy to numpy."
    )
    if not all(evaluation.is_reporting for evaluation in found):
        note += " Not all rows are whole episodes of the reporting band."
    for evaluation in found:
        if paper_of(evaluation) and evaluation.row.checkpoint != LAST:
            note += f" The paper's row at NFE {evaluation.nfe} is from {evaluation.row.checkpoint} of its training."
        if evaluation.unusual:
            note += f" NFE {evaluation.nfe}: {', '.join(evaluation.unusual)}."
        if taken := evaluation.summary.get("latency_alone"):
            note += (
                f" NFE {evaluation.nfe}: a chunk takes {taken['median_ms']:.1f} ms (p95 {taken['p95_ms']:.1f}) alone, "
                f"measured before the rollouts at a load of {taken['load']:.1f}, {taken['at']}."
            )
        for goal, (successes, episodes) in evaluation.summary.get("success_of_goal", {}).items():
            note += f" NFE {evaluation.nfe}, asked for {goal}: {successes}/{episodes}."
        if happened := evaluation.summary.get("condition_happened"):
            note += f" NFE {evaluation.nfe}: the condition's event came in {happened[0]} of {happened[1]} episodes."
        for label, count in evaluation.summary["failures"].items():
            note += f" NFE {evaluation.nfe}: {count} failed with {label}."
    return Table(f"{summary['experiment']} ({where})", COLUMNS, tuple(cells), (note,))


def paper_of(evaluation: Evaluation) -> PaperRow | None:
    """The printed row with the same policy and nfe."""
    return evaluation.row.paper if evaluation.row else None


def ours(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """The cells of a summary, in the order of COLUMNS[2:]."""
    cells = [alone(metric, summary) for metric in SHOWN]
    return (*cells[:BEHIND], percent(*summary["success_interval"]), *cells[BEHIND:])


def of_paper(paper: PaperRow) -> tuple[str, ...]:
    """The cells of a row of the paper, in the order of COLUMNS[2:]."""
    cells = [printed(metric, paper) for metric in SHOWN]
    interval = percent(*wilson_interval(paper.success, paper.episodes))
    return (*cells[:BEHIND], interval, *cells[BEHIND:])


def percent(low: float, high: float) -> str:
    """A share's interval in whole and tenths of a percent."""
    return f"{100 * low:.1f}-{100 * high:.1f}%"


def machine(summary: dict[str, Any]) -> str:
    """The machine of an evaluation in a few words."""
    fingerprint = summary["fingerprint"]
    cpu = fingerprint.get("machine", {}).get("cpu", "unknown CPU")
    return f"{fingerprint.get('workers', 1)} worker(s) of 1 thread on {cpu}"


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """One row for scripts: our metrics and the paper's row, null where it has none."""
    paper = paper_of(evaluation)
    return {
        "experiment": evaluation.summary["experiment"],
        "nfe": evaluation.nfe,
        "checkpoint_step": evaluation.summary["checkpoint_step"],
        "seeds": evaluation.summary["seeds"],
        "unusual": list(evaluation.unusual),
        "ours": {key: evaluation.summary.get(key) for key in IN_JSON},
        "paper": asdict(paper) if paper else None,
    }
