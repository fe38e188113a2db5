"""Learning curves: the loss of every run against its steps. Only losses of one kind share a panel."""

import json
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imfvla.figures.description import class_of, generator_name
from imfvla.figures.names import training_of
from imfvla.figures.panels import look, panels_of, plain_log_ticks, say_nothing_yet
from imfvla.figures.style import WIDTH, new_figure, style
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.results import Result
from imfvla.reporting.runs import Evaluation

COLUMNS, PANEL, LEGEND_LINE = 3, 1.9, 0.165  # panels in a row, inches, inches
TITLE, NAME = 36, 38  # characters a line
LEAST, MOST = 1e-30, 1e30  # of a loss that is drawn: on a wider axis no curve would be seen
WIDE = 8  # ratio of an axis's ends from which fewer ticks have numbers
OUTPUTS = {"data": "clean action as output", "velocity": "velocity as output"}  # by parametrisation
# what gives the loss of a generator other units: curves that differ in it are not compared
UNITS = (
    "parametrisation", "prediction", "times", "time_power", "adaptive_power", "compound_target", "instant_weight",
    "kl_weight", "power",
)  # fmt: skip
Curves = dict[str, tuple[np.ndarray, np.ndarray]]  # steps and losses by name


def learning_curves(results: Sequence[Result]) -> Figure:
    """Of all runs with an evaluation: a panel for each kind of loss, by task or table, most curves first."""
    rows = {title: _rows(_curves(found)) for title, found in panels_of(results).items()}
    heights = {
        title: [PANEL + LEGEND_LINE * max(_lines(curves) for _, curves in row) for row in found]
        for title, found in rows.items()
    }
    with style():
        totals = [0.3 + sum(of_title) for of_title in heights.values()]
        figure = new_figure(WIDTH, sum(totals))
        parts = figure.subfigures(len(rows), 1, height_ratios=totals, squeeze=False)[:, 0]
        for part, title in zip(parts, rows, strict=True):
            part.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
            cells = part.subfigures(len(rows[title]), COLUMNS, height_ratios=heights[title], squeeze=False)
            for of_row, row in zip(cells, rows[title], strict=True):
                for cell, (kind, curves) in zip(of_row, row, strict=False):
                    _panel(cell.subplots(), kind, curves)
    return figure


def _panel(axes: Axes, title: str, curves: Curves) -> None:
    axes.set_title("\n".join(wrap(title, TITLE)), fontsize=9)
    axes.set_xlabel("training step")
    is_log = all((loss > 0).all() for _, loss in curves.values())  # others have no place on a log axis
    axes.set_ylabel("loss, log axis" if is_log else "loss")
    axes.set_yscale("log" if is_log else "linear")
    for number, (label, (steps, loss)) in enumerate(curves.items()):
        axes.plot(steps, loss, label=label, linewidth=1.2, **look(number) | {"marker": ""})
    low, high = axes.get_ylim()
    if is_log:
        plain_log_ticks(axes.yaxis, (1, 2, 5) if high > WIDE * low else (1, 2, 3, 4, 5, 6, 8))
    if curves:
        axes.figure.legend(loc="outside lower left", fontsize=7.5, borderpad=0, labelspacing=0.3)
    else:
        say_nothing_yet(axes, "no curve yet")


def _lines(curves: Curves) -> int:
    """Of the legend."""
    return sum(name.count("\n") + 1 for name in curves)


def _rows(curves: Mapping[str, Curves]) -> list[list[tuple[str, Curves]]]:
    panels = sorted(curves.items(), key=lambda panel: -len(panel[1])) or [("", {})]
    return [panels[start : start + COLUMNS] for start in range(0, len(panels), COLUMNS)]


def _curves(results: Sequence[Result]) -> dict[str, Curves]:
    """Of each run, by kind of loss; those of several training seeds of a policy say theirs."""
    runs = {found.evaluation.run: found.evaluation for result in results for found in result.evaluated}
    kinds: dict[str, list[tuple[Evaluation, tuple[np.ndarray, np.ndarray]]]] = {}
    for evaluation in runs.values():
        steps, loss = learning_curve(evaluation.run)
        drawn = (np.abs(loss) >= LEAST) & (np.abs(loss) <= MOST)
        steps, loss = steps[drawn], loss[drawn]
        if steps.size:
            kinds.setdefault(json.dumps(_kind(evaluation)), []).append((evaluation, (steps, loss)))
    titles = _titles([json.loads(kind) for kind in kinds])
    return {
        title: {_name(evaluation): curve for evaluation, curve in found}
        for title, found in zip(titles, kinds.values(), strict=True)
    }


def _kind(evaluation: Evaluation) -> dict[str, Any]:
    """The generator, and those of its options that the unit of the loss depends on."""
    generator = evaluation.config.get("generator", {})
    units = {key: generator[key] for key in UNITS if key in generator}
    if class_of(generator) == "Regression":
        units.setdefault("power", 1)  # configs from before there was L2 do not say it
    return {"class": class_of(generator), **units}


def _titles(kinds: Sequence[Mapping[str, Any]]) -> list[str]:
    """The name of each generator, with what distinguishes it from others of its class."""
    titles = []
    for kind in kinds:
        rivals = [other for other in kinds if other["class"] == kind["class"] and other != kind]
        unit = next((key for key in UNITS if any(other.get(key) != kind.get(key) for other in rivals)), None)
        value = kind.get(unit)
        detail = OUTPUTS.get(str(value), f"{unit} {class_of(value) if isinstance(value, dict) else value}")
        name = generator_name(kind["class"], kind.get("power")) or "training loss"
        titles.append(f"{name}, {detail}" if unit not in (None, "power") else name)
    return [f"{title} ({n})" if titles.count(title) > 1 else title for n, title in enumerate(titles, 1)]


def _name(evaluation: Evaluation) -> str:
    name, changes = training_of(evaluation)
    seed = [f"seed {evaluation.training_seed}"] if evaluation.training_seed else []
    return "\n".join(wrap(", ".join([name, *changes, *seed]), NAME))
