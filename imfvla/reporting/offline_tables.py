"""What an offline evaluation found, as tables: of one run by channel and by step, of many runs a row each."""

from collections.abc import Sequence

import numpy as np

from imfvla.errors import UserError
from imfvla.reporting.offline import FILE, HOLD, NEAREST, Offline, read_offline
from imfvla.reporting.table import NOTHING, Table, number
from imfvla.reporting.tables import Document
from imfvla.storage.files import write_text
from imfvla.storage.run_directory import RunDirectory

MEASURE = "Mean absolute error of chunks against what was done at {decisions} decisions of {episodes} held-out episodes"


def print_offline(run: RunDirectory) -> None:
    """Prints the tables of a run that was evaluated offline and writes them to `offline.md` beside its numbers."""
    found = read_offline(run)
    if found is None:
        raise UserError(f"{run.path} has no {FILE}: run the training again, which evaluates it.")
    tables = (by_channel(found), by_step(found))
    write_text(run.path / "offline.md", "\n".join(table.markdown() for table in tables))
    for table in tables:
        table.print()


def by_channel(found: Offline) -> Table:
    """Error of each channel over the executed steps, in its unit."""
    names = list(found["error"])
    errors = [_mean(_errors(found, name)[: found["executed"]], axis=0) for name in names]
    cells = tuple(
        (channel, *(_cell(error[index]) for error in errors))
        for index, channel in enumerate(found["channels"])
    )
    title = f"{found['experiment']}: error by channel, over the {found['executed']} executed steps"
    return Table(title, ("Channel", *names), cells, (_note(found, "in the channel's unit"),))


def by_step(found: Offline) -> Table:
    """Error at some steps of the chunk, in deviations of the training actions, so that channels can be averaged."""
    names = list(found["error"])
    errors = [_mean(_errors(found, name) / _scale(found), axis=1) for name in names]
    pred = len(errors[0])
    steps = sorted({*(2**power for power in range(pred.bit_length()) if 2**power <= pred), pred})
    cells = tuple((str(step), *(_cell(error[step - 1]) for error in errors)) for step in steps)
    title = f"{found['experiment']}: error by step of the chunk, mean over the channels"
    return Table(
        title, ("Step", *names), cells, (_note(found, "in standard deviations of the training actions"),)
    )


def offline_table(runs: Sequence[tuple[str, Offline]]) -> Document:
    """A row for each policy and number of evaluations, beside the two baselines of the same decisions."""
    cells, keys = [], []
    for name, found in runs:
        hold, nearest = (_summary(found, baseline) for baseline in (HOLD, NEAREST))
        protocol = found["protocol"]
        for row in (row for row in found["error"] if row not in (HOLD, NEAREST)):
            nfe = row.removeprefix("infer")
            ours = _summary(found, row)
            size = (str(len(protocol["held_out"])), str(found["decisions"]))
            cells.append(
                (name, nfe, str(protocol["checkpoint_step"]), *size, *map(_cell, (ours, hold, nearest)))
            )
            keys.append(())
    columns = (
        "Policy",
        "nfe",
        "Weights",
        "Held out",
        "Decisions",
        "Error",
        "Hold still",
        "Nearest demonstration",
    )
    note = (
        "Mean absolute error of chunks over their executed steps and all channels, against what was done in episodes "
        "that training did not see, in standard deviations of the training actions. Hold still keeps the present "
        "state; nearest demonstration takes the actions that followed the most similar training state. A small error "
        "is no success: no environment was played."
    )
    table = Table("Offline evaluations", columns, tuple(cells), (note,), tuple(keys))
    return Document(table, Table(table.title, columns, table.rows))


def _note(found: Offline, unit: str) -> str:
    protocol = found["protocol"]
    text = MEASURE.format(episodes=len(protocol["held_out"]), decisions=found["decisions"])
    return f"{text}, {unit}; weights of step {protocol['checkpoint_step']}."


def _errors(found: Offline, name: str) -> np.ndarray:
    """(Tp, A), NaN where nothing counted."""
    return np.array(found["error"][name], float)


def _scale(found: Offline) -> np.ndarray:
    """(A,); a channel that never moves is left out."""
    deviation = np.array(found["deviation"], float)
    return np.where(deviation > 0, deviation, np.nan)


def _summary(found: Offline, name: str) -> float | None:
    return _mean((_errors(found, name) / _scale(found))[: found["executed"]].ravel(), axis=0)


def _mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Over what is a number; NaN where nothing is."""
    counted = np.isfinite(values)
    return np.where(counted, values, 0).sum(axis) / np.where(counted.any(axis), counted.sum(axis), np.nan)


def _cell(value: float) -> str:
    return NOTHING if not np.isfinite(value) else number(float(value), 4)
