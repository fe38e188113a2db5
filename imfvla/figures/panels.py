"""Panels that several figures share: one for each task, legends, axes."""

from collections.abc import Iterable, Sequence

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from imfvla.figures.style import CYCLE, GREY, MARKERS
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.results import Result

LINES = ("-", "--", ":", "-.")


def tasks_of(results: Sequence[Result]) -> dict[str, str]:
    """Title by task, a panel for each: the tasks of printed tables, then the others of the results."""
    mapping = read_mapping()
    drawn = {table.task for table in mapping.of_rows if table.printed is not None}
    names = [task.name for task in mapping.tasks if task.name in drawn]
    others = sorted({result.task for result in results if result.task is not None} - set(names))
    return {name: mapping.task(name).title for name in (*names, *others)}


def stages_of(task: str, results: Sequence[Result]) -> tuple[str, ...]:
    """Names of a task's stages, as its evaluations or else tables.yaml have them; none where it has no stages.

    None too where the episodes have stages of several tasks, as in a scene that serves more than one.
    """
    recorded = [
        found.evaluation.summary["stages"]
        for result in results
        for found in result.evaluated
        if "stages" in found.evaluation.summary
    ]
    names = tuple(recorded[0]) if recorded else read_mapping().task(task).stages or ()
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


def look(number: int) -> dict[str, str]:
    """Colour, line and marker of the line of this number: no two of the first 28 are equal."""
    turn = number // len(CYCLE)
    return {
        "color": CYCLE[number % len(CYCLE)],
        "linestyle": LINES[turn % len(LINES)],
        "marker": MARKERS[turn % len(MARKERS)],
    }
