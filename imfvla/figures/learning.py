"""Learning curves: the loss of every run against its steps, one panel a task."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from imfvla.figures.panels import TASKS, legend_below, look, plain_log_ticks, say_nothing_yet, task_panels
from imfvla.figures.style import style
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.results import Result


def learning_curves(results: Sequence[Result]) -> Figure:
    """Of all runs with an evaluation. Losses of different generators are measured in different units."""
    curves = {task: _curves([result for result in results if result.task == task]) for task in TASKS}
    with style():
        figure, axes = task_panels(3.8, max(map(len, curves.values())))
        for task, axis in axes.items():
            axis.set_xlabel("training step")
            axis.set_ylabel("training loss, log axis")
            axis.set_yscale("log")
            for number, (label, (steps, loss)) in enumerate(curves[task].items()):
                axis.plot(steps, loss, label=label, linewidth=1.3, **look(number) | {"marker": ""})
            plain_log_ticks(axis.yaxis, (1, 2, 3, 4, 5, 6, 7, 8))
            if not curves[task]:
                say_nothing_yet(axis, "no curve yet")
            legend_below(axis, lines=max(map(len, curves.values())))
    return figure


def _curves(results: Sequence[Result]) -> dict:
    """Steps and losses of each run, by policy and training seed; of a run's several evaluations the first names it."""
    found, read = {}, set()
    for result in results:
        for evaluated in result.evaluated:
            evaluation = evaluated.evaluation
            if evaluation.run in read:
                continue
            read.add(evaluation.run)
            seed = f", seed {evaluation.training_seed}" if evaluation.training_seed else ""
            steps, loss = learning_curve(evaluation.run)
            if steps.size:
                found[f"{result.policy}{seed}"] = steps, loss
    return found
