"""Learning curves of a run: `metrics.jsonl`."""

import json
from pathlib import Path

import numpy as np

from imfvla.errors import UserError


def learning_curve(run: Path, metric: str = "loss") -> tuple[np.ndarray, np.ndarray]:
    """Steps and values (N,) of a metric; empty where the run kept none. A last line that a kill cut off is left out.

    Raises UserError naming file and line where another line is damaged.
    """
    path = run / "metrics.jsonl"
    if not path.exists():
        return np.empty(0), np.empty(0)
    lines = path.read_text(encoding="utf-8").split("\n")
    steps, values = [], []
    for number, line in enumerate(lines[:-1], 1):
        try:
            row = json.loads(line)
            step, value = row["step"], row.get(metric)
        except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"{path}, line {number} is no row of metrics: {error}; restore or delete the file."
            ) from error
        if value is not None:
            steps.append(step)
            values.append(value)
    return np.array(steps, float), np.array(values, float)
