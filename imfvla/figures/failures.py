"""Where episodes fail: for those without success, the first stage that was not reached, a bar for each result."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from imfvla.figures.names import result_name
from imfvla.figures.panels import panels_of, say_nothing_yet, stages_of
from imfvla.figures.style import INK, VERMILION, WIDTH, new_figure, style
from imfvla.reporting.results import Result
from imfvla.reporting.rows import first_failed_stage

SHADES = LinearSegmentedColormap.from_list("failures", [VERMILION, "#fbe3d0"])
BAR, FRAME = 0.19, 1.25  # inches: of a bar with its gap, of what is above and below the bars of a panel
LEAST = 4  # percent that a number within a bar needs


def failed_stages(results: Sequence[Result]) -> Figure:
    """A bar for each result: the share of episodes whose first failed stage is each of the stages.

    A panel for each task and each table that is not the paper's; tasks without stages have none.
    """
    rows = {title: _sorted(found) for title, found in panels_of(results).items()}
    stages = {title: names for title, found in rows.items() if (names := stages_of(found))}
    heights = [FRAME + BAR * max(len(rows[title]), 2) for title in stages]
    with style():
        figure = new_figure(WIDTH, sum(heights, start=0.0) or FRAME)
        if not stages:
            say_nothing_yet(figure.subplots(), "no task with stages")
            return figure
        parts = figure.subfigures(len(stages), 1, height_ratios=heights, squeeze=False)[:, 0]
        for part, title in zip(parts, stages, strict=True):
            axes = part.subplots()
            axes.set_title(title, weight="bold")
            _bars(axes, stages[title], rows[title])
    return figure


def _sorted(results: Sequence[Result]) -> list[Result]:
    """Results of one name side by side, names in their order, NFE ascending."""
    names = list(dict.fromkeys(map(result_name, results)))
    return sorted(results, key=lambda result: (names.index(result_name(result)), result.nfe))


def _bars(axes: Axes, stages: Sequence[str], results: Sequence[Result]) -> None:
    axes.set_xlabel("episodes that fail [%], by the first stage that they do not reach")
    axes.grid(axis="y", visible=False)
    if not results:
        say_nothing_yet(axes, "no row measured yet")
        axes.set_yticks([])
        return
    counts = [Counter(first_failed_stage(row) for row in result.episodes) for result in results]
    places, left = np.arange(len(results)), np.zeros(len(results))
    for stage, label in enumerate(stages):
        shares = np.array([100 * count[stage] / count.total() for count in counts])
        color = SHADES(stage / max(len(stages) - 1, 1))
        axes.barh(places, shares, 0.75, left=left, color=color, edgecolor="white", linewidth=0.5, label=label)
        for place, share, start in zip(places, shares, left, strict=True):
            if share >= LEAST:
                axes.text(start + share / 2, place, f"{share:.0f}", ha="center", va="center", fontsize=7.5,
                          color="white" if stage == 0 else INK)  # fmt: skip
        left += shares
    for place, end in zip(places, left, strict=True):
        axes.annotate(f"{round(end, 1):g}", (end, place), xytext=(4, 0), textcoords="offset points", va="center",
                      fontsize=8, weight="bold")  # fmt: skip
    names = [result_name(result) for result in results]
    shown = [name if place == 0 or names[place - 1] != name else "" for place, name in enumerate(names)]
    blank = "\N{FIGURE SPACE}"  # as wide as a digit
    labels = [f"{name}   NFE {result.nfe:{blank}>3}" for name, result in zip(shown, results, strict=True)]
    axes.set_yticks(places, labels, fontsize=8)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(results) - 0.4, -0.6)
    axes.set_xlim(0, max(1.08 * max(left), 10))
    axes.figure.legend(loc="outside lower center", ncols=len(stages))
