"""Panels that several figures share: one for each task, legends, axes."""

from collections.abc import Iterable, Sequence
from itertools import count

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from imfvla.figures.description import class_of
from imfvla.figures.style import CYCLE, GREY, MARKERS
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.results import Result

LINES = ("-", "--", ":", "-.")


def panels_of(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Results by the title of their panel: the printed tables' tasks first, then the others, by title.

    A table that is not the paper's has a panel of its own, with its title: it may play a task of the paper with other
    demonstrations.
    """
    mapping = read_mapping()
    drawn = {table.task for table in mapping.of_rows if table.printed is not None}
    found: dict[str, list[Result]] = {task.title: [] for task in mapping.tasks if task.name in drawn}
    first = list(found)
    for result in results:
        if result.is_missing:
            continue
        title = own_table(result) or mapping.task(result.task or "").title
        found.setdefault(title, []).append(result)
    return {title: found[title] for title in (*first, *sorted(set(found) - set(first)))}


def own_table(result: Result) -> str | None:
    """The title of the result's table, None where that is one of the paper's.

    A result that is no row belongs to the table of its experiment's rows, to the paper's if there are several.
    """
    mapping = read_mapping()
    rows = (
        [result.row]
        if result.row
        else [row for row in mapping.rows if row.experiment == result.first.experiment]
    )
    of_rows = {table.name: table for table in mapping.of_rows}
    tables = [of_rows[row.table] for row in rows if row.table in of_rows]
    printed = any(table.printed is not None for table in tables)
    return None if printed or not tables else tables[0].title


def stages_of(results: Sequence[Result]) -> tuple[str, ...]:
    """Names of the stages of one task, as its evaluations or else tables.yaml have them; none where it has no stages.

    None too where the episodes have stages of several tasks, as in a scene that serves more than one.
    """
    recorded = [
        found.evaluation.summary["stages"]
        for result in results
        for found in result.evaluated
        if "stages" in found.evaluation.summary
    ]
    tasks = [result.task for result in results if result.task is not None]
    named = read_mapping().task(tasks[0]).stages if tasks else None
    names = tuple(recorded[0]) if recorded else named or ()
    counts = {len(row["first_step_of_stage"]) for result in results for row in result.episodes}
    return names if counts <= {len(names)} else ()


def say_nothing_yet(axes: Axes, text: str) -> None:
    """An empty panel that says that nothing is measured."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color=GREY)


def plain_log_ticks(axis: Axis, digits: Sequence[int] = (1, 2, 5)) -> None:
    """Numbers that begin with these digits, in place of powers of ten, on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def nfe_ticks(axes: Axes, nfes: Iterable[int]) -> list[int]:
    """A log axis of network calls with a tick at each number that occurs; returns these, ascending."""
    ticks = sorted(set(nfes))
    axes.set_xscale("log")
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    return ticks


# The number, for `look`, of each generator: its colour in every figure that compares methods.
NUMBERS = {
    "StagedMeanFlow": 0, "FlowMatching": 1, "DenoisingDiffusion": 2, "ActionChunking": 4, "ImprovedMeanFlow": 5,
    "Regression": 6,
}  # fmt: skip


def numbers(results: Sequence[Result]) -> list[int]:
    """A number for each result, of another method each: that of its generator, else the lowest that is left."""
    usual = [NUMBERS.get(class_of(result.first.config.get("generator", {}))) for result in results]
    left = (number for number in count() if number not in usual)
    taken: set[int] = set()
    found = []
    for number in usual:
        own = next(left) if number is None or number in taken else number
        taken.add(own)
        found.append(own)
    return found


def look(number: int) -> dict[str, str]:
    """Colour, line and marker of the line of this number: no two of the first 28 are equal."""
    turn = number // len(CYCLE)
    return {
        "color": CYCLE[number % len(CYCLE)],
        "linestyle": LINES[turn % len(LINES)],
        "marker": MARKERS[turn % len(MARKERS)],
    }
