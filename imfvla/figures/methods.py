"""What each method of a table needs for its success: network calls and time of a chunk, and time of training."""

from collections.abc import Sequence
from itertools import groupby

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.panels import look, nfe_ticks, numbers, plain_log_ticks, say_nothing_yet
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import WIDTH, new_figure, style
from imfvla.reporting.curves import training_minutes
from imfvla.reporting.results import Result

SPREAD = 1.3  # of all methods at one number of calls, as a factor


def success_by_cost(results: Sequence[Result]) -> Figure:
    """Success of a table's rows against NFE and against the median time of a chunk, a line for each method.

    The mean time would show a pause of the machine. The legend has the mean time of the trainings.
    """
    measured = sorted((r for r in results if not r.is_missing), key=lambda r: (r.row.method, r.nfe))
    lines = {method: [*line] for method, line in groupby(measured, key=lambda r: r.row.method)}
    order = [method for method in dict.fromkeys(r.row.method for r in results) if method in lines]
    with style():
        figure = new_figure(WIDTH, 3.9)
        left, right = figure.subplots(1, 2, sharey=True)
        left.set_xlabel("network calls for a chunk (NFE), log axis")
        right.set_xlabel("median time of a chunk [ms], log axis")
        left.set_ylabel("success-like [%]")
        if not order:
            for axes in (left, right):
                say_nothing_yet(axes, "no row measured yet")
            return figure
        looks = numbers([lines[method][0] for method in order])
        for place, (method, number) in enumerate(zip(order, looks, strict=True)):
            line = lines[method]
            # so that intervals do not hide each other, and yet stand at their tick
            shift = SPREAD ** ((place + 0.5) / len(order) - 0.5)
            _draw(left, line, [shift * r.nfe for r in line], number, method)
            _draw(right, line, [r.metrics["inference_ms_median"].value for r in line], number, method)
        nfe_ticks(left, (r.nfe for r in measured))
        right.set_xscale("log")
        plain_log_ticks(right.xaxis)
        left.set_ylim(-3, 103)
        handles = left.get_legend_handles_labels()[0]
        names = [f"{method}, {_training(lines[method])}" for method in order]
        figure.legend(handles, names, loc="outside lower center", ncols=2)
    return figure


def _draw(axes: Axes, line: Sequence[Result], x: Sequence[float], number: int, method: str) -> None:
    shares = [result.metrics["success_share"].scaled(100) for result in line]
    axes.errorbar(x, [share.value for share in shares], yerr=errors(shares), capsize=2, markersize=4.5, linewidth=1.2,
                  label=method, **look(number))  # fmt: skip


def _training(line: Sequence[Result]) -> str:
    """Number and mean time of a method's trainings, such as "3 trainings of 12 min"."""
    runs = {found.evaluation.run for result in line for found in result.evaluated}
    minutes = training_minutes(runs)
    count = "1 training" if len(runs) == 1 else f"{len(runs)} trainings"
    return count if minutes is None else f"{count} of {minutes:.0f} min"
