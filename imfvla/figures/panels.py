"""Panels that several figures share: one for each task, legends, axes."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from imfvla.figures.style import CYCLE, GREY, MARKERS

TASKS = {"socket": "socket peg insertion", "transfer": "object transfer"}
LINES = ("-", "--", ":", "-.")


def say_nothing_yet(axes: Axes, text: str) -> None:
    """An empty panel that says that nothing is measured."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color=GREY)


def plain_log_ticks(axis: Axis, digits: Sequence[int] = (1, 2, 5)) -> None:
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
