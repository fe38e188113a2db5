"""Two runs compared: which starts each succeeded from, and differences with their intervals."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from imfvla.figures.panels import say_nothing_yet
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import BLUE, GREY, INK, ORANGE, PALE, SKY, WIDTH, new_figure, style
from imfvla.reporting.statistics.power import ALPHA
from imfvla.reporting.two_runs import ComparedMeasure, Duel

OUTCOMES = (("both", BLUE), ("A alone", SKY), ("B alone", ORANGE), ("neither", PALE))
AXES = {
    "Success": "success,\nA minus B [points]",
    "Reward": "average reward,\nA minus B",
    "Speed": "speed, A over B",
}


def two_runs(duels: Sequence[Duel]) -> Figure:
    """A line for each pair of evaluations; intervals are 95%, points are filled where a difference is significant."""
    with style():
        figure = new_figure(WIDTH, 1.9 + 0.5 * len(duels))
        outcomes, *differences = figure.subplots(1, 1 + len(AXES), sharey=True, width_ratios=[1.5, 1, 1, 1])
        _outcomes(outcomes, duels)
        for number, axes in enumerate(differences):
            _differences(axes, [duel.compared[number] for duel in duels])
        outcomes.set_yticks(
            range(len(duels)), [duel.label.replace(" against ", "\nagainst ") for duel in duels]
        )
        outcomes.set_ylim(len(duels) - 0.4, -0.6)
        handles, labels = outcomes.get_legend_handles_labels()
        labels = [f"{label} succeeded" for label in labels]
        for face, text in ((BLUE, f"a difference: Holm-corrected p < {ALPHA}"), ("white", "none shown")):
            handles.append(Line2D([], [], marker="o", linestyle="", color=BLUE, markerfacecolor=face))
            labels.append(text)
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def counts(duel: Duel) -> tuple[int, int, int, int]:
    """Starts from which both, A alone, B alone and neither succeeded."""
    ours, theirs = (
        np.array([row["success"] for row in found.episodes], bool) for found in (duel.ours, duel.theirs)
    )
    pairs = (ours & theirs, ours & ~theirs, ~ours & theirs, ~ours & ~theirs)
    return tuple(int(found.sum()) for found in pairs)


def _outcomes(axes: Axes, duels: Sequence[Duel]) -> None:
    axes.set_xlabel("starts")
    axes.grid(visible=False)
    left = np.zeros(len(duels))
    for (label, color), numbers in zip(OUTCOMES, np.array([counts(duel) for duel in duels]).T, strict=True):
        bars = axes.barh(range(len(duels)), numbers, 0.6, left, color=color, edgecolor="white", label=label)
        texts = [str(number) if number else "" for number in numbers]
        axes.bar_label(
            bars, texts, label_type="center", fontsize=7.5, color="white" if color == BLUE else INK
        )
        left += numbers
    axes.set_xlim(0, max(left))


def _differences(axes: Axes, compared: Sequence[ComparedMeasure]) -> None:
    measure = compared[0].measure
    axes.set_xlabel(AXES[measure.title])
    axes.axvline(measure.neutral, color=GREY, linewidth=1)
    axes.grid(axis="y", visible=False)
    known = [
        (place, found)
        for place, found in enumerate(compared)
        if found.contrast and found.contrast.result.value is not None
    ]
    for place in set(range(len(compared))) - {place for place, _ in known} if known else ():
        axes.text(0.5, place, "not compared", transform=axes.get_yaxis_transform(), ha="center", va="center",
                  fontsize=7.5, color=GREY)  # fmt: skip
    for place, found in known:
        result = found.contrast.result.scaled(measure.scale)
        face = BLUE if found.is_shown else "white"
        axes.errorbar(
            [result.value],
            [place],
            xerr=errors([result]),
            fmt="o",
            color=BLUE,
            markerfacecolor=face,
            capsize=2.5,
        )
    if not known:
        say_nothing_yet(axes, "not compared")
