"""Success and returns against delay, and success against the severity of each condition."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.config.condition import NONE, SEVERITIES
from imfvla.config.protocol import CONTINUE, HOLD, MEASURED, NO_PREFIX, RUNNING
from imfvla.figures.panels import look, say_nothing_yet
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import WIDTH, new_figure, style
from imfvla.reporting.results import Result

Point = tuple[float, Result]
COLUMNS = 4
SUCCESS, RETURN = "success_share", "avg_return"
SCALES = {SUCCESS: 100, RETURN: 1}


def success_by_delay(results: Sequence[Result]) -> Figure:
    """Successes and returns for each condition and for what the robot does meanwhile; the paused clock is at 0.

    Methods that are measured on the paused clock alone have no line.
    """
    found = [result for result in results if not result.is_missing]
    conditions = list(dict.fromkeys(_change(result, "condition", NONE) for result in found)) or [NONE]
    panels = [
        (condition, metric, meanwhile)
        for condition in conditions
        for metric in (SUCCESS, RETURN)
        for meanwhile in (HOLD, CONTINUE)
    ]
    methods = _methods(found)
    with style():
        figure = new_figure(WIDTH, 0.9 + 3.6 * len(conditions))
        axes = figure.subplots(2 * len(conditions), 2, sharex=True, sharey="row", squeeze=False).ravel()
        for axis, (condition, metric, meanwhile) in zip(axes, panels, strict=True):
            world = "" if condition == NONE else f", {condition}"
            if metric == SUCCESS:
                axis.set_title(f"the robot {'holds' if meanwhile == HOLD else 'continues'} meanwhile{world}")
            lines = {
                method: [
                    (_delay(result), result)
                    for result in found
                    if _line(result) == method
                    and _change(result, "condition", NONE) == condition
                    and _change(result, "meanwhile", HOLD if _is_running(result) else meanwhile) == meanwhile
                ]
                for method in methods
            }
            _draw(axis, lines, methods, metric, apart=3)
            _say_unit(axis, metric, is_left=meanwhile == HOLD)
        for axis in axes[-2:]:
            axis.set_xlabel("delay of a chunk [ms]")
        _legend(figure)
    return figure


def success_by_severity(results: Sequence[Result]) -> Figure:
    """A panel for each condition; the unchanged world is at 0, for methods that are measured in another one."""
    found = [result for result in results if not result.is_missing]
    conditions = [
        name for name in dict.fromkeys(_change(r, "condition", NONE) for r in found) if name != NONE
    ]
    methods = _methods(found)
    count = max(len(conditions), 1)
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    with style():
        figure = new_figure(WIDTH, 0.9 + 2.2 * rows)
        axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axis in axes[count:]:
            axis.set_axis_off()
        for axis, condition in zip(axes, conditions or [NONE], strict=False):
            axis.set_title(condition if conditions else "")
            axis.set_xlabel("severity")
            axis.set_xticks([0, *SEVERITIES])
            lines = {
                method: [
                    (_change(result, "severity", 0), result)
                    for result in found
                    if _line(result) == method and _change(result, "condition", NONE) in (NONE, condition)
                ]
                for method in methods
            }
            _draw(axis, lines, methods, SUCCESS, apart=0.05)
            _say_unit(axis, SUCCESS, is_left=axis in axes[:count:columns])
        _legend(figure)
    return figure


def _draw(
    axes: Axes, lines: dict[str, list[Point]], methods: Sequence[str], metric: str, apart: float
) -> None:
    """A line for each method, `apart` from the next one along x, so that intervals do not hide each other."""
    if not any(lines.values()):
        say_nothing_yet(axes, "nothing measured yet")
    for method, points in lines.items():
        if points:
            points = sorted(points, key=lambda point: point[0])
            measured = [result.metric(metric).scaled(SCALES[metric]) for _, result in points]
            axes.errorbar(
                [x + apart * (methods.index(method) - (len(methods) - 1) / 2) for x, _ in points],
                [one.value for one in measured],
                yerr=errors(measured),
                label=method,
                **look(methods.index(method)),
                markersize=4.5,
                linewidth=1.2,
                capsize=2,
            )


def _say_unit(axes: Axes, metric: str, *, is_left: bool) -> None:
    if metric == SUCCESS:
        axes.set_ylim(-3, 103)
    else:
        axes.set_ylim(bottom=0)
    if is_left:
        axes.set_ylabel("success-like [%]" if metric == SUCCESS else "average return")


def _legend(figure: Figure) -> None:
    handles = {
        text: handle
        for axes in figure.axes
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=2)


def _methods(results: Sequence[Result]) -> list[str]:
    """Of the results in another world or on a running clock: others have nothing to be compared with."""
    return list(dict.fromkeys(_line(result) for result in results if result.row.changes))


def _line(result: Result) -> str:
    """The name of a line: the method, and how its chunks begin where that is not left to chance."""
    prefix = _change(result, "prefix", NO_PREFIX)
    return result.row.label if prefix == NO_PREFIX else f"{result.row.label}, {prefix} prefix"


def _change(result: Result, key: str, usual: object) -> object:
    return dict(result.row.changes).get(key, usual)


def _is_running(result: Result) -> bool:
    return _change(result, "clock", None) == RUNNING


def _delay(result: Result) -> float:
    asked = _change(result, "delay_ms", 0)
    if asked != MEASURED:
        return float(asked)
    return max(found.evaluation.summary["latency_alone"]["median_ms"] for found in result.evaluated)
