"""The tables, ours beside the paper's printed values, and the evaluations that are in none of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

from imfvla.reporting.cells import BY_NAME, SHOWN, TITLES, printed, with_its_interval
from imfvla.reporting.comparisons import Compared
from imfvla.reporting.mapping.comparisons import Comparison
from imfvla.reporting.metrics import METRICS
from imfvla.reporting.notes import detectable_success, label, names, pairing
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.published import PublishedRow
from imfvla.reporting.results import Result
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.table import MISSING, NOTHING, REFUSED, TOO_FEW, Table, with_interval
from imfvla.reporting.table_row import machine
from imfvla.storage.run_directory import LAST

COLUMNS = ("Row", "nfe", "Source", *TITLES)
SUCCESS = BY_NAME["success_episodes"].title
PRINTED_FIELDS = [field.name for field in fields(PaperRow)][
    3:
]  # what it has beside table, method and setting
INTERVALS = (
    "In brackets: 95% intervals; of counts Wilson's, of means and medians BCa bootstrap over episodes, with several "
    "training seeds over these too. Latency: mean over all replannings, numpy to numpy; with two training "
    "seeds its interval is over episodes alone."
)


@dataclass(frozen=True, slots=True)
class Document:
    """A table for people, and its numbers for programs."""

    shown: Table
    data: Table


def row_table(
    title: str,
    results: Sequence[Result],
    notes: Sequence[str] = (),
    published: Sequence[PublishedRow] = (),
) -> Document:
    """A table of rows: ours under each row that the paper prints, and those that the paper does not have.

    Rates that other papers print head it, with their sources as notes.
    """
    cells = [
        (
            row.label,
            NOTHING,
            "published",
            *(f"{row.success_percent:g}%" if c == SUCCESS else NOTHING for c in COLUMNS[3:]),
        )
        for row in published
    ]
    keys: list[tuple[str, ...]] = [()] * len(cells)
    notes = (*notes, *dict.fromkeys(f"Published: {row.method}, {row.source}." for row in published))
    for result in results:
        if result.paper:
            cells.append(
                (
                    result.row.label,
                    str(result.nfe),
                    "paper",
                    *(printed(metric, result.paper) for metric in SHOWN),
                )
            )
            keys.append(())
        cells.append((result.row.label, str(result.nfe), "ours", *ours(result)))
        keys.append((result.name,))
    missing = tuple((result.row.label, result.answer.command) for result in results if result.is_missing)
    first = [result.evaluated[0].episodes for result in results if not result.is_missing]
    described = (_described(results), detectable_success(len(first[0]))) if first else ()
    every = (*described, INTERVALS, *notes)
    return Document(
        Table(title, COLUMNS, tuple(cells), every, tuple(keys), missing),
        Table(title, *_data(results)),
    )


def other_table(results: Sequence[Result]) -> Document:
    """Evaluations of the reporting band that are in no row of the tables."""
    title = "Other evaluations"
    cells = tuple((result.policy, str(result.nfe), _weights(result), *ours(result)) for result in results)
    keys = tuple((result.name,) for result in results)
    notes = (INTERVALS,) if results else ("There are none.",)
    columns = ("Policy", "nfe", "Weights", *COLUMNS[3:])
    return Document(Table(title, columns, cells, notes, keys), Table(title, *_data(results)))


def comparison_table(title: str, compared: Sequence[Compared], notes: Sequence[str] = ()) -> Document:
    """Rows of ours against each other: every ratio that the paper prints, beside it, or differences of our own."""
    has_paper = any(found.comparison.paper for found in compared)
    cells = []
    for found in compared:
        paper = found.comparison.paper
        printed = ((paper.result if paper else NOTHING),) if has_paper else ()
        ours = MISSING if found.is_missing else REFUSED if found.refused else shown(found)
        cells.append((*names(found.comparison), *printed, ours, p_value(found.p), p_value(found.p_holm)))
    commands = {
        result.row.label: result.answer.command
        for found in compared
        for result in (found.row, found.baseline)
        if result.is_missing
    }
    measured = [found for found in compared if found.result]
    if measured:
        notes = (*notes, *pairing(measured))
    refused = tuple(
        f"{label(found.comparison)}: refused, because {found.refused}." for found in compared if found.refused
    )
    columns = ("Comparison", "Metric", *(("Paper",) if has_paper else ()), "Ours", "p", "p (Holm)")
    keys = tuple((found.row.name, found.baseline.name) for found in compared)
    table = Table(title, columns, tuple(cells), (*notes, *refused), keys, tuple(commands.items()))
    return Document(table, Table(title, *_comparison_data(compared)))


def ours(result: Result) -> tuple[str, ...]:
    """The cells of a row of ours, in the order of COLUMNS[3:]."""
    return tuple(with_its_interval(metric, result) for metric in SHOWN)


def derived(comparison: Comparison, row: PaperRow, baseline: PaperRow) -> str:
    """A result of Table 3 from two printed rows, as the paper prints it: "1.76×" or "+15"."""
    column = BY_NAME[comparison.of].printed
    value, against = getattr(row, column), getattr(baseline, column)
    if value is None or against is None:
        return NOTHING
    if comparison.operation == "difference":
        return f"{value - against:+g}"
    ratio = value / against if comparison.operation == "ratio" else against / value
    return f"{ratio:.2f}×"


def shown(found: Compared) -> str:
    """A result of ours with its interval, in the form of the paper's."""
    if found.comparison.operation != "difference":
        return with_interval(found.result, 2, "×")
    value = found.result
    bounds = TOO_FEW if value.low is None else f"[{value.low:+.1f}, {value.high:+.1f}]"
    number = f"{value.value:+g}" if float(value.value).is_integer() else f"{value.value:+.1f}"
    return f"{number} {bounds}"


def p_value(p: float | None) -> str:
    """Three digits, or that it is smaller."""
    if p is None:
        return NOTHING
    return "<0.001" if p < 0.0005 else f"{p:.3f}"


def _weights(result: Result) -> str:
    evaluations = [found.evaluation for found in result.evaluated]
    steps = evaluations[0].summary["checkpoint_step"]
    seeds = ", ".join(str(evaluation.training_seed) for evaluation in evaluations)
    return f"step {steps} of {evaluations[0].training_steps}, seed {seeds}"


def _described(results: Sequence[Result]) -> str:
    """The protocol that all rows of a table share, and the machines on which latencies were measured."""
    found = [evaluated.evaluation for result in results for evaluated in result.evaluated]
    protocol, seeds = found[0].summary["protocol"], found[0].seeds
    machines = list(dict.fromkeys(machine(evaluation.summary) for evaluation in found))
    task = f"{protocol['task']} ({protocol['variant']})"
    text = f"Ours: {len(seeds)} episodes from seeds {seeds[0]} to {seeds[-1]}, {task}"
    if len(machines) == 1:
        return f"{text}; {machines[0]}."
    return f"{text}. Latencies are from {len(machines)} machines, so they are not comparable: {'; '.join(machines)}."


def _data(results: Sequence[Result]) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Columns and rows of the CSV."""
    columns = [
        "row",
        "method",
        "setting",
        "experiment",
        "run",
        "nfe",
        "checkpoint",
        "training_seeds",
        "episodes",
    ]
    for metric in METRICS:
        ends = ("", "_low", "_high") if metric.estimate else ("",)
        columns += [f"{metric.column}{end}" for end in ends]
    columns += [*(f"paper_{name}" for name in PRINTED_FIELDS), "status", "command"]
    return tuple(columns), tuple(_data_row(result) for result in results)


def _data_row(result: Result) -> tuple[str, ...]:
    row, evaluations = result.row, [found.evaluation for found in result.evaluated]
    first = evaluations[0] if evaluations else None
    cells = [
        result.name,
        row.method if row else "",
        row.setting if row else "",
        row.experiment if row else first.experiment,
        row.run if row else first.key,
        str(result.nfe),
        str(first.summary["checkpoint_step"]) if first else row.checkpoint if row.checkpoint != LAST else "",
        " ".join(str(evaluation.training_seed) for evaluation in evaluations),
        str(len(result.episodes)) if first else "",
    ]
    for metric in METRICS:
        measured = result.metrics[metric.name]
        numbers = (measured.value, measured.low, measured.high) if metric.estimate else (measured.value,)
        cells += ["" if value is None else f"{value:.{metric.data_digits}f}" for value in numbers]
    for name in PRINTED_FIELDS:
        value = getattr(result.paper, name) if result.paper else None
        cells.append("" if value is None else str(value))
    command = result.answer.command if result.answer else ""
    return (*cells, MISSING if result.is_missing else "measured", command)


def _comparison_data(compared: Sequence[Compared]) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    columns = (
        "comparison", "metric", "row", "baseline", "of", "operation", "paper", "ours", "ours_low", "ours_high", "p",
        "p_holm", "p_signed_rank", "p_signed_rank_holm", "status", "reason",
    )  # fmt: skip
    cells = []
    for found in compared:
        comparison, paper = found.comparison, found.comparison.paper
        result = found.result or Measured(None)
        numbers = (
            result.value,
            result.low,
            result.high,
            found.p,
            found.p_holm,
            found.p_ranks,
            found.p_ranks_holm,
        )
        cells.append(
            (
                *names(comparison), found.row.name, found.baseline.name, comparison.of,
                comparison.operation, paper.result if paper else "",
                *("" if value is None else f"{value:.6g}" for value in numbers),
                MISSING if found.is_missing else REFUSED if found.refused else "measured", found.refused or "",
            )
        )  # fmt: skip
    return columns, tuple(cells)
