"""Where episodes end: a histogram of the first stage that was not reached, one panel a task."""

import re
from collections import Counter
from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from imfvla.figures.panels import TASKS, legend_below, say_nothing_yet, task_panels
from imfvla.figures.style import GREEN, INK, VERMILION, style
from imfvla.reporting.metrics import Row
from imfvla.reporting.results import Result

STAGES = {
    "socket": ("grasp both", "lift both", "at the mouth", "inside", "seated"),
    "transfer": ("grasp", "lift", "both hold", "handed over"),
}
SHADES = LinearSegmentedColormap.from_list("failures", [VERMILION, "#fbe3d0"])


def first_failed_stage(row: Row) -> int | None:
    """The index of the first stage that never held, None where all of them did."""
    return next((index for index, step in enumerate(row["first_step_of_stage"]) if step < 0), None)


def failed_stages(results: Sequence[Result]) -> Figure:
    """A bar for each row: the shares of episodes whose first failed stage is each of the stages, and of successes."""
    measured = [result for result in results if not result.is_missing]
    rows = {task: [result for result in measured if result.task == task] for task in TASKS}
    with style():
        lines = max((_name(result).count("\n") + 1 for result in measured), default=1)
        figure, axes = task_panels(1.4 + (0.14 + 0.08 * lines) * max(map(len, rows.values())), 2)
        for task, axis in axes.items():
            _bars(axis, STAGES[task], rows[task])
    return figure


def _bars(axes: Axes, stages: Sequence[str], results: Sequence[Result]) -> None:
    axes.set_xlabel("episodes [%], by first failed stage")
    axes.set_xlim(0, 100)
    axes.grid(axis="y", visible=False)
    if not results:
        say_nothing_yet(axes, "no row measured yet")
        axes.set_yticks([])
        return
    counts = [Counter(first_failed_stage(row) for row in result.episodes) for result in results]
    places, left = np.arange(len(results)), np.zeros(len(results))
    for stage in (*range(len(stages)), None):
        shares = np.array([100 * count[stage] / count.total() for count in counts])
        color = GREEN if stage is None else SHADES(stage / (len(stages) - 1))
        label = "none failed" if stage is None else stages[stage]
        axes.barh(places, shares, 0.7, left=left, color=color, edgecolor="white", linewidth=0.5, label=label)
        for place, share, start in zip(places, shares, left, strict=True):
            if share >= 8:
                dark = stage is None or stage == 0
                axes.text(start + share / 2, place, f"{share:.0f}", ha="center", va="center", fontsize=6.5,
                          color="white" if dark else INK)  # fmt: skip
        left += shares
    axes.set_yticks(places, [_name(result) for result in results], fontsize=7)
    axes.set_ylim(len(results) - 0.4, -0.6)
    legend_below(axes, columns=3)


def _name(result: Result) -> str:
    """In short lines where it stands in no table, since it is long then, and without the training's last step."""
    if result.row:
        return result.name
    name = f"{result.policy}, infer{result.nfe}" if result.is_last else result.name
    return "\n".join(wrap(re.sub("[/,] ?", ", ", name), 36))
