"""Success against the number of network evaluations, one panel a task, one line a policy."""

from collections.abc import Sequence
from itertools import groupby

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from imfvla.figures.panels import TASKS, legend_below, look, say_nothing_yet, task_panels
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import style
from imfvla.reporting.results import Result
from imfvla.reporting.runs import Evaluation


def success_by_evaluations(results: Sequence[Result]) -> Figure:
    """Of policies evaluated with several numbers, with the weights of the end of their training and Wilson intervals.

    What a policy does with another scale of noise has its colour, and a hollow marker.
    """
    last = sorted((result for result in results if result.is_last), key=lambda result: result.policy)
    lines = [sorted(line, key=lambda result: result.nfe) for _, line in groupby(last, lambda r: r.policy)]
    lines = [line for line in lines if len(line) > 1]
    by_task = {task: [line for line in lines if line[0].task == task] for task in TASKS}
    most = max(map(len, by_task.values()))
    with style():
        figure, axes = task_panels(3.8, most)
        for task, axis in axes.items():
            _panel(axis, by_task[task])
            legend_below(axis, lines=most)
    return figure


def _panel(axes: Axes, lines: Sequence[Sequence[Result]]) -> None:
    axes.set_xlabel("network evaluations, log axis")
    axes.set_ylabel("success-like episodes [%]")
    axes.set_xscale("log")
    trainings = list(dict.fromkeys(_evaluation(line).policy for line in lines))
    for number, line in enumerate(lines):
        evaluation = _evaluation(line)
        shares = [result.metrics["success_share"].scaled(100) for result in line]
        shift = 1 + 0.02 * (number - (len(lines) - 1) / 2)  # so that intervals do not hide each other
        x, y = [shift * result.nfe for result in line], [share.value for share in shares]
        how = look(trainings.index(evaluation.policy))
        if not evaluation.is_usual:
            how |= {"linestyle": "--", "markerfacecolor": "white"}
        axes.errorbar(x, y, yerr=errors(shares), capsize=2.5, label=evaluation.label, **how)
    if not lines:
        say_nothing_yet(axes, "no policy measured with several numbers yet")
    lowest = axes.dataLim.y0 if lines else 0
    axes.set_ylim(max(-3, 10 * (lowest // 10) - 3), 103)
    ticks = sorted({result.nfe for line in lines for result in line}) or [1, 10, 100]
    axes.set_xlim(0.75 * ticks[0], 1.35 * ticks[-1])
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())


def _evaluation(line: Sequence[Result]) -> Evaluation:
    return line[0].evaluated[0].evaluation
