"""Success against the number of network calls (NFE): a panel for each method on each task, a line for each change."""

from collections.abc import Sequence
from itertools import groupby

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.names import policy_of
from imfvla.figures.panels import look, nfe_ticks, own_table, panels_of, say_nothing_yet
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import WIDTH, new_figure, style
from imfvla.reporting.results import Result

COLUMNS = 3
Line = list[Result]


def success_by_evaluations(results: Sequence[Result]) -> Figure:
    """Policies evaluated at several NFE, with the weights at the end of training and Wilson intervals.

    Tables that are not the paper's are left out.
    """
    shown = [result for result in results if result.is_last and own_table(result) is None]
    last = sorted(shown, key=lambda result: result.policy)
    lines = [sorted(line, key=lambda result: result.nfe) for _, line in groupby(last, lambda r: r.policy)]
    lines = [line for line in lines if len(line) > 1]
    panels = {
        title: _by_method([line for line in lines if line[0] in found])
        for title, found in panels_of([line[0] for line in lines]).items()
    }
    changes = list(dict.fromkeys(_policy(line)[1] for line in lines))
    rows = {title: -(-max(len(methods), 1) // COLUMNS) for title, methods in panels.items()}
    with style():
        figure = new_figure(WIDTH, 0.7 + 2.7 * sum(rows.values()))
        parts = figure.subfigures(len(rows), 1, height_ratios=list(rows.values()), squeeze=False)[:, 0]
        for part, title in zip(parts, panels, strict=True):
            part.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
            axes = part.subplots(rows[title], COLUMNS, sharey=True, squeeze=False)
            _methods(axes.ravel().tolist(), panels[title], changes)
            for side in axes[:, 0]:
                side.set_ylabel("success-like [%]")
        handles = {
            label: handle
            for part in parts
            for axis in part.axes
            for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=3)
    return figure


def _by_method(lines: Sequence[Line]) -> dict[str, list[Line]]:
    found: dict[str, list[Line]] = {}
    for line in lines:
        found.setdefault(_policy(line)[0], []).append(line)
    return found


def _methods(axes: Sequence[Axes], methods: dict[str, list[Line]], changes: Sequence[str]) -> None:
    for axis in axes[max(len(methods), 1) :]:
        axis.set_axis_off()
    if not methods:
        say_nothing_yet(axes[0], "no policy measured\nwith several numbers yet")
    for axis, (method, lines) in zip(axes, methods.items(), strict=False):
        axis.set_title(method)
        _panel(axis, lines, changes)
    lowest = min((axis.dataLim.y0 for axis in axes[: len(methods)]), default=0)
    axes[0].set_ylim(max(-3, 10 * (lowest // 10) - 3), 103)


def _panel(axes: Axes, lines: Sequence[Line], changes: Sequence[str]) -> None:
    axes.set_xlabel("network calls for a chunk (NFE)")
    for number, line in enumerate(lines):
        shares = [result.metrics["success_share"].scaled(100) for result in line]
        shift = 1.1 ** (number - (len(lines) - 1) / 2)  # so that intervals do not hide each other
        x, y = [shift * result.nfe for result in line], [share.value for share in shares]
        change = _policy(line)[1]
        axes.errorbar(x, y, yerr=errors(shares), capsize=2, label=change, markersize=4.5, linewidth=1.2,
                      **look(changes.index(change)))  # fmt: skip
    ticks = nfe_ticks(axes, (result.nfe for line in lines for result in line))
    axes.set_xlim(0.75 * ticks[0], 1.35 * ticks[-1])


def _policy(line: Line) -> tuple[str, str]:
    return policy_of(line[0].first)
