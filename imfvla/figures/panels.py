"""Figures with one panel for each task, each with its legend below."""

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from imfvla.figures.style import CYCLE, GREY, MARKERS, new_figure

TASKS = {"socket": "socket peg insertion", "transfer": "object transfer"}
LINES = ("-", "--", ":", "-.")
LEGEND_LINE = 0.17  # inches


def task_panels(height: float, legend_lines: int) -> tuple[Figure, dict[str, Axes]]:
    """A figure whose axes are `height` inches high, beside room for legends; axes by task."""
    figure = new_figure(10.4, height + LEGEND_LINE * legend_lines)
    axes = {}
    for part, (task, title) in zip(figure.subfigures(1, 2), TASKS.items(), strict=True):
        axes[task] = part.subplots()
        axes[task].set_title(title)
    return figure, axes


def legend_below(axes: Axes, columns: int = 1, lines: int = 0) -> None:
    """Lists what `axes` shows below it, in at least so many lines, which keeps panels equally high."""
    handles, labels = axes.get_legend_handles_labels()
    for _ in range(lines - len(handles)):
        handles.append(Line2D([], [], alpha=0))
        labels.append(" ")
    axes.figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=7.5)


def say_nothing_yet(axes: Axes, text: str) -> None:
    """Where nothing is measured, an empty panel that says so."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color=GREY)


def plain_log_ticks(axis: Axis, digits: tuple[int, ...] = (1, 2, 5)) -> None:
    """Numbers that begin with these digits, in place of powers of ten, on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def look(number: int) -> dict[str, str]:
    """Colour, line and marker of the line of this number: no two of the first 28 are equal."""
    turn = number // len(CYCLE)
    return {
        "color": CYCLE[number % len(CYCLE)],
        "linestyle": LINES[turn % len(LINES)],
        "marker": MARKERS[turn % len(MARKERS)],
    }
