"""Average reward and success-like episodes of every row of a table as grouped bars."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.reward_latency import errors
from imfvla.figures.style import BLUE, GREY, INK, WIDTH, new_figure, style
from imfvla.reporting.results import Result
from imfvla.reporting.statistics.measured import Measured

BAR = 0.38  # share of the distance between two groups


def ablations(results: Sequence[Result]) -> Figure:
    """A group for each row, the paper's bar beside ours; 95% intervals on ours and on the paper's counts."""
    with style():
        figure = new_figure(WIDTH, 1.4 + 0.36 * len(results))
        axes = figure.subplots(1, 2, sharey=True)
        _bars(
            axes[0],
            results,
            "average reward",
            [_reward(r) for r in results],
            [r.metrics["avg_return"] for r in results],
        )
        _bars(axes[1], results, "success-like episodes [%]", [r.paper_success_share.scaled(100) for r in results],
              [r.metrics["success_share"].scaled(100) for r in results])  # fmt: skip
        axes[0].set_yticks(
            range(len(results)), [f"{r.row.method}\n{r.row.setting}" for r in results], fontsize=7.5
        )
        axes[0].set_ylim(len(results) - 0.4, -0.6)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _reward(result: Result) -> Measured:
    return Measured(result.row.paper.avg_reward if result.row.paper else None)


def _bars(
    axes: Axes, results: Sequence[Result], name: str, paper: Sequence[Measured], ours: Sequence[Measured]
) -> None:
    axes.set_xlabel(name)
    axes.grid(axis="y", visible=False)
    places = np.arange(len(results))
    styles = {"facecolor": "white", "edgecolor": GREY, "hatch": "////"}
    for offset, measured, label, look in (
        (-BAR / 2, paper, "paper (printed)", styles),
        (BAR / 2, ours, "ours, with 95% interval", {"facecolor": BLUE}),
    ):
        values = np.array([np.nan if m.value is None else m.value for m in measured])
        axes.barh(
            places + offset, values, BAR, xerr=errors(measured), label=label, ecolor=INK, capsize=2, **look
        )
    for place, result in zip(places, results, strict=True):
        if result.is_missing:
            axes.annotate("missing", (0, place + BAR / 2), (3, 0), textcoords="offset points", va="center",
                          fontsize=6.5, color=GREY)  # fmt: skip
