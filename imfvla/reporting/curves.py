"""Learning curves of a run: `metrics.jsonl`."""

from collections.abc import Iterable
from pathlib import Path
from statistics import fmean

import numpy as np

from imfvla.storage.metrics import read_metrics


def learning_curve(run: Path, metric: str = "loss") -> tuple[np.ndarray, np.ndarray]:
    """Steps and values (N,) of a metric; empty where the run kept none. A last line that a kill cut off is left out.

    Raises UserError naming file and line where another line is damaged.
    """
    rows = [row for row in read_metrics(run / "metrics.jsonl") if row.get(metric) is not None]
    return np.array([row["step"] for row in rows], float), np.array([row[metric] for row in rows], float)


def training_minutes(runs: Iterable[Path]) -> float | None:
    """Mean time of the trainings of these runs, of those that say it; None where none does."""
    spent = [learning_curve(run, "train_s")[1] for run in runs]
    minutes = [seconds[-1] / 60 for seconds in spent if len(seconds)]
    return fmean(minutes) if minutes else None
