"""Average reward of a table's rows against the time of a chunk, with the Pareto frontier."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D, Bbox

from imfvla.figures.panels import plain_log_ticks
from imfvla.figures.style import BLACK, CYCLE, GREY, MARKERS, WIDTH, new_figure, style
from imfvla.reporting.paper import PaperRow
from imfvla.reporting.results import Result
from imfvla.reporting.statistics.measured import Measured

LABEL_HEIGHTS = (-2, 7, -11, 15, -19, 23, -27)  # points above the middle of a marker


@dataclass(frozen=True, slots=True)
class Point:
    """A policy at one NFE; a lower cost and a higher gain are better."""

    method: str
    label: str  # NFE, "" where the paper does not give it
    latency_ms: float
    reward: Measured


def reward_latency(results: Sequence[Result]) -> Figure:
    """The printed values on the left, ours on the right: latencies of different machines do not share an axis."""
    printed = [_printed(result.paper) for result in results]
    ours = [_ours(result) for result in results if not result.is_missing]
    methods = list(dict.fromkeys(point.method for point in (*printed, *ours) if point))
    with style():
        figure = new_figure(WIDTH, 4.6)
        axes = figure.subplots(1, 2, sharey=True)
        _panel(axes[0], "Paper (its machines)", [p for p in printed if p], methods)
        _panel(axes[1], "Here", [p for p in ours if p], methods)
        highest = max((p.reward.high or p.reward.value for p in (*printed, *ours) if p), default=1.0)
        axes[0].set_ylim(0, 1.12 * highest)
        axes[0].set_ylabel("average reward of an episode")
        handles = {
            handle.get_label(): handle for axis in axes for handle in axis.get_legend_handles_labels()[0]
        }
        figure.legend(
            handles.values(),
            handles,
            loc="outside lower center",
            ncols=min(len(handles), 4),
            title="beside points: network calls for a chunk (NFE)",
            title_fontsize=8,
        )
        figure.draw_without_rendering()  # places of labels are measured on the final layout
        for axis, points in zip(axes, (printed, ours), strict=True):
            _write_labels(axis, [p for p in points if p], methods)
    return figure


def pareto_frontier(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (cost, gain) for which no other has at most the cost and more gain, sorted by cost."""
    frontier: list[tuple[float, float]] = []
    for cost, gain in sorted(points, key=lambda point: (point[0], -point[1])):
        if not frontier or gain > frontier[-1][1]:
            frontier.append((cost, gain))
    return frontier


def _printed(paper: PaperRow | None) -> Point | None:
    if paper is None or paper.latency_ms is None:
        return None
    evaluations = re.match(r"infer(\d+)", paper.setting)
    return Point(
        paper.method, evaluations[1] if evaluations else "", paper.latency_ms, Measured(paper.avg_reward)
    )


def _ours(result: Result) -> Point | None:
    latency, reward = result.metrics["inference_ms_mean"], result.metrics["avg_return"]
    if latency.value is None:
        return None
    return Point(result.row.method, str(result.row.nfe), latency.value, reward)


def _panel(axes: Axes, title: str, points: Sequence[Point], methods: Sequence[str]) -> None:
    axes.set_title(title)
    axes.set_xlabel("time of one action chunk [ms], log axis")
    axes.set_xscale("log")
    plain_log_ticks(axes.xaxis)
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


def errors(measured: Sequence[Measured]) -> np.ndarray:
    """Distances (2, N) from values down and up to their intervals, nan where there is none."""
    pairs = [
        (np.nan, np.nan) if m.low is None or m.high is None else (m.value - m.low, m.high - m.value)
        for m in measured
    ]
    return np.array(pairs, float).T


def _write_labels(axes: Axes, points: Sequence[Point], methods: Sequence[str]) -> None:
    """Beside each point, at the first place where it hides no label or interval, else where it hides fewest."""
    scale = 72 / axes.figure.dpi
    frame = axes.bbox.transformed(Affine2D().scale(scale))
    taken = [_extent(axes, point).transformed(Affine2D().scale(scale)) for point in points]
    for point in sorted(points, key=lambda point: -point.reward.value):
        x, y = axes.transData.transform((point.latency_ms, point.reward.value)) * scale
        width = 5 * len(point.label)
        places = [(side, up) for up in LABEL_HEIGHTS for side in (6, -6 - width)]
        boxes = {at: Bbox.from_bounds(x + at[0], y + at[1] - 1, width, 8) for at in places}
        inside = {at: box for at, box in boxes.items() if frame.x0 < box.x0 and box.x1 < frame.x1} or boxes
        best = min(inside, key=lambda at: inside[at].count_overlaps(taken))
        taken.append(inside[best])
        place = (point.latency_ms, point.reward.value)
        color = _look(point.method, methods)[0]
        axes.annotate(point.label, place, best, textcoords="offset points", fontsize=7, color=color)


def _extent(axes: Axes, point: Point) -> Bbox:
    """What the marker and interval of `point` cover [pixels]."""
    low, high = point.reward.low, point.reward.high
    ends = [point.reward.value if end is None else end for end in (low, high)]
    corners = axes.transData.transform([(point.latency_ms, end) for end in ends])
    return Bbox(corners).padded(4)


def _look(method: str, methods: Sequence[str]) -> tuple[str, str]:
    """Colour and marker."""
    number = methods.index(method)
    return CYCLE[number % len(CYCLE)], MARKERS[number % len(MARKERS)]
