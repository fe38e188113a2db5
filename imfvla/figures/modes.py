"""What samples are beside the demonstrations: when a gripper closes, which way a wrist rolls, spread and jumps."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PURPLE,
    SKY,
    VERMILION,
    WIDTH,
    new_figure,
    style,
)

BROWN = "#7a5230"
FATE_COLORS = {
    "closes": BLUE, "holds on": SKY, "waits": PALE, "lets go": ORANGE, "between": VERMILION,
}  # fmt: skip
FATE_NAMES = {
    "closes": "closes", "holds on": "closes, lets go too late", "waits": "waits", "lets go": "lets go too early",
    "between": "neither open nor closed",
}  # fmt: skip
LINES = (GREEN, PURPLE, BROWN, GREY)  # one for each NFE: colours that no fate has
ROW_HEIGHT = 2.7  # inches
FEWEST_BARS = 3  # that a panel has room for, so that one alone is not a block


def modes_figure(measured: Mapping[str, Any], title: str) -> Figure:
    """A row of two panels for what is known of the samples: grippers, wrists, and always spread and jumps."""
    rows = measured["rows"]
    parts = [
        draw
        for key, draw in (("closed_by", _grippers), ("rolls", _wrists), ("spread", _spread))
        if any(key in row for row in rows.values())
    ]
    with style():
        figure = new_figure(WIDTH, 0.3 + ROW_HEIGHT * len(parts))
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
        panels = figure.subplots(len(parts), 2, squeeze=False)
        for draw, (left, right) in zip(parts, panels, strict=True):
            draw(measured, left, right)
    return figure


def _look(index: int) -> dict[str, Any]:
    """Of row `index`, the demonstrations first."""
    if index == 0:
        return {"color": BLACK, "linewidth": 2.2}
    again, color = divmod(index - 1, len(LINES))
    return {"color": LINES[color], "linewidth": 1.3, "linestyle": ("-", "--", ":")[again % 3]}


def _label(name: str) -> str:
    return name if not name.isdecimal() else f"{name} NFE"


def _name_bars(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), [_label(name) for name in names])
    axes.set_ylim(max(len(names), FEWEST_BARS) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")


def _grippers(measured: Mapping[str, Any], left: Axes, right: Axes) -> None:
    rows = measured["rows"]
    for index, (name, row) in enumerate(rows.items()):
        share = 100 * np.array(row["closed_by"])
        left.step(np.arange(1, len(share) + 1), share, where="post", label=_label(name), **_look(index))
    left.axvline(measured["executed"], color=GREY, linewidth=0.8, linestyle=":")
    left.set(xlabel="step of the chunk (dotted: executed)", ylabel="closed by then [%]", ylim=(0, 100))
    left.set_title("When the gripper closes")
    left.legend(loc="upper left")
    names = list(rows)
    base = np.zeros(len(names))
    for fate, color in FATE_COLORS.items():
        share = 100 * np.array([row["fates"][fate] for row in rows.values()])
        right.barh(range(len(names)), share, left=base, color=color, height=0.7, label=FATE_NAMES[fate])
        base += share
    _name_bars(right, names)
    right.set(xlim=(0, 100), xlabel="samples [%]")
    right.set_title("What the samples do")
    right.legend(
        loc="upper center", bbox_to_anchor=(0.4, -0.22), ncols=3, columnspacing=1.0, handlelength=1.2
    )


def _wrists(measured: Mapping[str, Any], left: Axes, right: Axes) -> None:
    rows = measured["rows"]
    bridge, arrived = measured["bridge_rad"], measured["arrived_rad"]
    limit = 1.05 * max(arrived, *(np.abs(row["rolls"]).max() for row in rows.values()))
    edges = np.linspace(-limit, limit, 42)
    left.axvspan(-bridge, bridge, color=PALE, linewidth=0)
    for index, (name, row) in enumerate(rows.items()):
        density, _ = np.histogram(row["rolls"], edges, density=True)
        left.stairs(density, edges, label=_label(name), **_look(index))
    left.set(xlabel="roll of a wrist [rad] (grey: between both ways)", ylabel="density of samples")
    left.set_title("Which way the wrist rolls")
    left.legend(loc="upper center")
    places = np.arange(len(rows))
    for shift, key, color, label in (
        (-0.2, "bridge", VERMILION, f"within {bridge} rad of the middle"),
        (0.2, "arrived", BLUE, f"beyond {arrived} rad"),
    ):
        share = [100 * row[key] for row in rows.values()]
        bars = right.barh(places + shift, share, height=0.36, color=color, label=label)
        right.bar_label(bars, fmt="%.1f", padding=2, fontsize=8)
    _name_bars(right, list(rows))
    right.set(xlim=(0, 112), xlabel="samples [%]")
    right.set_title("Between the two ways, and arrived")
    right.legend(loc="upper center", bbox_to_anchor=(0.4, -0.22), ncols=2)


def _spread(measured: Mapping[str, Any], left: Axes, right: Axes) -> None:
    rows = {name: row for name, row in measured["rows"].items() if "spread" in row}
    for axes, key, digits, label, title in (
        (
            left,
            "spread_ratio",
            2,
            "spread over noise / error (1: as demonstrations)",
            "Dependence on the noise",
        ),
        (right, "jump_rad", 3, "disagreement of shared steps [rad]", "Jumps between consecutive chunks"),
    ):
        values = [np.nan if row[key] is None else row[key] for row in rows.values()]
        bars = axes.barh(
            range(len(rows)),
            values,
            height=0.6,
            color=[_look(index + 1)["color"] for index in range(len(rows))],
        )
        axes.bar_label(bars, fmt=f"%.{digits}f", padding=2, fontsize=8)
        _name_bars(axes, list(rows))
        axes.margins(x=0.15)
        axes.set(xlabel=label)
        axes.set_title(title)
    left.axvline(1, color=BLACK, linewidth=1, linestyle=":")
    left.set_xlim(0, max(1.2, left.get_xlim()[1]))
