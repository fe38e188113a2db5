"""Figure 3: average reward on the socket task against the time of a chunk, with the Pareto frontier."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.panels import plain_log_ticks
from imfvla.figures.style import BLACK, CYCLE, GREY, MARKERS, new_figure, style
from imfvla.reporting.measured import Measured
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.results import Result


@dataclass(frozen=True, slots=True)
class Point:
    """A policy with a number of evaluations: the lower and the further up, the better."""

    method: str
    label: str
    latency_ms: float
    reward: Measured


def reward_latency(results: Sequence[Result]) -> Figure:
    """The printed values on the left, ours on the right: latencies of different machines share no axis."""
    printed = [_printed(result.paper) for result in results]
    ours = [_ours(result) for result in results if not result.is_missing]
    methods = list(dict.fromkeys(point.method for point in (*printed, *ours) if point))
    with style():
        figure = new_figure(9.6, 4.4)
        axes = figure.subplots(1, 2, sharey=True)
        _panel(axes[0], "Paper (its machines)", [p for p in printed if p], methods)
        _panel(axes[1], "Here", [p for p in ours if p], methods)
        highest = max((p.reward.high or p.reward.value for p in (*printed, *ours) if p), default=1.0)
        axes[0].set_ylim(0, 1.12 * highest)
        axes[0].set_ylabel("average reward of an episode")
        handles = {
            handle.get_label(): handle for axis in axes for handle in axis.get_legend_handles_labels()[0]
        }
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=min(len(handles), 4))
        figure.draw_without_rendering()  # places of labels are measured on the final layout
        for axis, points in zip(axes, (printed, ours), strict=True):
            _write_labels(axis, [p for p in points if p], methods)
    return figure


def pareto_frontier(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of (cost, gain): those that none costs at most as much as and gains more than, by cost."""
    frontier: list[tuple[float, float]] = []
    for cost, gain in sorted(points, key=lambda point: (point[0], -point[1])):
        if not frontier or gain > frontier[-1][1]:
            frontier.append((cost, gain))
    return frontier


def _printed(paper: PaperRow | None) -> Point | None:
    if paper is None or paper.latency_ms is None:
        return None
    evaluations = re.match(r"infer\d+", paper.setting)
    return Point(
        paper.method, evaluations.group() if evaluations else "", paper.latency_ms, Measured(paper.avg_reward)
    )


def _ours(result: Result) -> Point | None:
    latency, reward = result.metrics["inference_ms_mean"], result.metrics["avg_return"]
    if latency.value is None:
        return None
    return Point(result.row.method, f"infer{result.row.nfe}", latency.value, reward)


def _panel(axes: Axes, title: str, points: Sequence[Point], methods: Sequence[str]) -> None:
    axes.set_title(title)
    axes.set_xlabel("time of one action chunk [ms], log axis")
    axes.set_xscale("log")
    if not points:
        axes.text(0.5, 0.5, "no row measured yet", transform=axes.transAxes, ha="center", color=GREY)
        return
    for method in methods:
        chosen = [point for point in points if point.method == method]
        if not chosen:
            continue
        color, marker = _look(method, methods)
        x, y = [p.latency_ms for p in chosen], [p.reward.value for p in chosen]
        axes.errorbar(
            x, y, yerr=errors([p.reward for p in chosen]), fmt=marker, color=color, capsize=2.5, label=method
        )
    frontier = pareto_frontier([(p.latency_ms, p.reward.value) for p in points])
    axes.step(*zip(*frontier, strict=True), where="post", color=BLACK, linewidth=1, linestyle="--", zorder=1,
              label="Pareto frontier")  # fmt: skip
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.3, high * 1.9)  # room for labels
    plain_log_ticks(axes.xaxis)


def errors(measured: Sequence[Measured]) -> np.ndarray:
    """Distances (2, N) from values down and up to their intervals, nan where there is none."""
    pairs = [
        (np.nan, np.nan) if m.low is None or m.high is None else (m.value - m.low, m.high - m.value)
        for m in measured
    ]
    return np.array(pairs, float).T


def _write_labels(axes: Axes, points: Sequence[Point], methods: Sequence[str]) -> None:
    """Right of each point, or below where it would hide the label of a higher one."""
    taken: list[np.ndarray] = []
    for point in sorted(points, key=lambda point: -point.reward.value):
        at = axes.transData.transform((point.latency_ms, point.reward.value)) * 72 / axes.figure.dpi
        offsets = [(7, 1), (7, -8), (7, -16), (-34, 1), (-34, -9), (7, -25), (7, 10)]
        free = [o for o in offsets if all(np.any(np.abs(at + o - t) > (32, 8)) for t in taken)] or offsets[:1]
        taken.append(at + free[0])
        place = (point.latency_ms, point.reward.value)
        color = _look(point.method, methods)[0]
        axes.annotate(point.label, place, free[0], textcoords="offset points", fontsize=7, color=color)


def _look(method: str, methods: Sequence[str]) -> tuple[str, str]:
    """Colour and marker."""
    number = methods.index(method)
    return CYCLE[number % len(CYCLE)], MARKERS[number % len(MARKERS)]
