"""Success against the number of network evaluations, one panel a task, one line a policy."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from imfvla.figures.panels import legend_below, look, say_nothing_yet, task_panels
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import style
from imfvla.reporting.results import Result


def success_by_evaluations(results: Sequence[Result]) -> Figure:
    """Of all policies evaluated, with the weights of the end of their training and Wilson intervals."""
    last = [result for result in results if result.is_last]
    policies = {
        task: list(dict.fromkeys(r.policy for r in last if r.task == task)) for task in ("socket", "transfer")
    }
    with style():
        figure, axes = task_panels(3.8, max(map(len, policies.values())))
        for task, axis in axes.items():
            _panel(axis, policies[task], [result for result in last if result.task == task])
            legend_below(axis, lines=max(map(len, policies.values())))
    return figure


def _panel(axes: Axes, policies: Sequence[str], results: Sequence[Result]) -> None:
    axes.set_xlabel("network evaluations, log axis")
    axes.set_ylabel("success-like episodes [%]")
    axes.set_xscale("log")
    axes.set_ylim(-3, 103)
    for number, policy in enumerate(policies):
        chosen = sorted(
            (result for result in results if result.policy == policy), key=lambda result: result.nfe
        )
        shares = [result.metrics["success_share"].scaled(100) for result in chosen]
        shift = 1 + 0.02 * (number - (len(policies) - 1) / 2)  # so that intervals do not hide each other
        x, y = [shift * result.nfe for result in chosen], [share.value for share in shares]
        axes.errorbar(x, y, yerr=errors(shares), capsize=2.5, label=policy, **look(number))
    ticks = sorted({result.nfe for result in results}) or [1, 10, 100]
    axes.set_xlim(0.75 * ticks[0], 1.35 * ticks[-1])
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    if not results:
        say_nothing_yet(axes, "no row measured yet")
