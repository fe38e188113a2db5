"""Success and returns against delay, and success against the severity of each condition."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.config.condition import NONE, SEVERITIES
from imfvla.config.protocol import CONTINUE, HOLD, MEASURED, NO_PREFIX, PREFIXES, RUNNING
from imfvla.figures.panels import LINES, numbers, say_nothing_yet
from imfvla.figures.reward_latency import errors
from imfvla.figures.style import CYCLE, MARKERS, WIDTH, new_figure, style
from imfvla.reporting.mapping.settings import short_labels
from imfvla.reporting.results import Result

Point = tuple[float, Result]
Line = tuple[str, str]  # label of the row, and how its chunks begin
COLUMNS = 4
SUCCESS, RETURN = "success_share", "avg_return"
SCALES = {SUCCESS: 100, RETURN: 1}
SPREAD_MS, SPREAD_SEVERITY = 12, 0.25  # of the lines at one place; less than the places are apart


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
    looks, shared = _looks(found)
    with style():
        figure = new_figure(WIDTH, 0.6 + 3.8 * len(conditions) + 0.1 * len(looks))
        axes = figure.subplots(2 * len(conditions), 2, sharex=True, sharey="row", squeeze=False).ravel()
        for axis, (condition, metric, meanwhile) in zip(axes, panels, strict=True):
            world = "" if condition == NONE else f", {condition}"
            if metric == SUCCESS:
                axis.set_title(f"the robot {'holds' if meanwhile == HOLD else 'continues'} meanwhile{world}")
            lines = {
                line: [
                    (_delay(result), result)
                    for result in found
                    if _line(result) == line
                    and _change(result, "condition", NONE) == condition
                    and _change(result, "meanwhile", HOLD if _is_running(result) else meanwhile) == meanwhile
                ]
                for line in looks
            }
            _draw(axis, lines, looks, metric, SPREAD_MS)
            _say_unit(axis, metric, is_left=meanwhile == HOLD)
        for axis in axes[-2:]:
            axis.set_xlabel("delay of a chunk [ms]")
        _legend(figure, shared)
    return figure


def success_by_severity(results: Sequence[Result]) -> Figure:
    """A panel for each condition; the unchanged world is at 0, for methods that are measured in another one."""
    found = [result for result in results if not result.is_missing]
    conditions = [
        name for name in dict.fromkeys(_change(r, "condition", NONE) for r in found) if name != NONE
    ]
    looks, shared = _looks(found)
    count = max(len(conditions), 1)
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    with style():
        figure = new_figure(WIDTH, 0.6 + 2.2 * rows + 0.1 * len(looks))
        axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axis in axes[count:]:
            axis.set_axis_off()
        for number, (axis, condition) in enumerate(zip(axes, conditions or [NONE], strict=False)):
            axis.set_title(condition if conditions else "")
            if number + columns >= count:  # nothing below it
                axis.set_xlabel("severity")
                axis.tick_params(labelbottom=True)
            axis.set_xticks([0, *SEVERITIES])
            lines = {
                line: [
                    (_change(result, "severity", 0), result)
                    for result in found
                    if _line(result) == line and _change(result, "condition", NONE) in (NONE, condition)
                ]
                for line in looks
            }
            _draw(axis, lines, looks, SUCCESS, SPREAD_SEVERITY)
            _say_unit(axis, SUCCESS, is_left=axis in axes[:count:columns])
        _legend(figure, shared)
    return figure


def _draw(
    axes: Axes, lines: dict[Line, list[Point]], looks: dict[Line, dict[str, str]], metric: str, spread: float
) -> None:
    """A line for each method, side by side within `spread` of x, so that intervals do not hide each other."""
    lines = {line: sorted(points, key=lambda point: point[0]) for line, points in lines.items() if points}
    if not lines:
        say_nothing_yet(axes, "nothing measured yet")
    for number, (line, points) in enumerate(lines.items()):
        shift = spread * ((number + 0.5) / len(lines) - 0.5)
        measured = [result.metric(metric).scaled(SCALES[metric]) for _, result in points]
        axes.errorbar(
            [x + shift for x, _ in points],
            [one.value for one in measured],
            yerr=errors(measured),
            **looks[line],
            markersize=4.5,
            linewidth=1.2,
            elinewidth=0.8,
            capsize=2,
        )


def _say_unit(axes: Axes, metric: str, *, is_left: bool) -> None:
    if metric == SUCCESS:
        axes.set_ylim(-3, 103)
    else:
        axes.set_ylim(bottom=0)
    if is_left:
        axes.set_ylabel("success-like [%]" if metric == SUCCESS else "average return")


def _legend(figure: Figure, shared: str) -> None:
    handles = {
        text: handle
        for axes in figure.axes
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(
            handles.values(),
            handles,
            loc="outside lower center",
            ncols=2,
            title=f"all: {shared}" if shared else None,
        )


def _looks(results: Sequence[Result]) -> tuple[dict[Line, dict[str, str]], str]:
    """Name and look of each line: a colour for each policy, a marker for its NFE, a style of line for its prefix.

    Of the results in another world or on a running clock: others have nothing to be compared with. Then what the
    settings of all rows have, which is in no name.
    """
    changed = [result for result in results if result.row.changes]
    names, shared = short_labels([result.row for result in changed])
    policies: dict[tuple[str, tuple[str, ...]], Result] = {}
    for result in changed:
        policies.setdefault((result.row.experiment, result.row.overrides), result)
    places = dict(zip(policies, numbers(list(policies.values())), strict=True))
    nfes = sorted({result.row.nfe for result in changed})
    found = {}
    for result in sorted(changed, key=lambda result: PREFIXES.index(_line(result)[1])):
        label, prefix = line = _line(result)
        turn, colour = divmod(places[result.row.experiment, result.row.overrides], len(CYCLE))
        found[line] = {
            "label": names[label] if prefix == NO_PREFIX else f"{names[label]}, {prefix} prefix",
            "color": CYCLE[colour],
            "fillstyle": "none" if turn % 2 else "full",
            "marker": MARKERS[nfes.index(result.row.nfe) % len(MARKERS)],
            "linestyle": LINES[PREFIXES.index(prefix)],
        }
    return found, shared


def _line(result: Result) -> Line:
    return result.row.label, _change(result, "prefix", NO_PREFIX)


def _change(result: Result, key: str, usual: object) -> object:
    return dict(result.row.changes).get(key, usual)


def _is_running(result: Result) -> bool:
    return _change(result, "clock", None) == RUNNING


def _delay(result: Result) -> float:
    asked = _change(result, "delay_ms", 0)
    if asked != MEASURED:
        return float(asked)
    return max(found.evaluation.summary["latency_alone"]["median_ms"] for found in result.evaluated)
