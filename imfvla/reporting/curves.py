"""Learning curves of a run: `metrics.jsonl`."""

from pathlib import Path

import numpy as np

from imfvla.errors import UserError
from imfvla.storage.documents import parse_json, read_lines

REMEDY = "restore or delete the file"


def learning_curve(run: Path, metric: str = "loss") -> tuple[np.ndarray, np.ndarray]:
    """Steps and values (N,) of a metric; empty where the run kept none. A last line that a kill cut off is left out.

    Raises UserError naming file and line where another line is damaged.
    """
    path = run / "metrics.jsonl"
    if not path.exists():
        return np.empty(0), np.empty(0)
    lines = read_lines(path, REMEDY)
    steps, values = [], []
    for number, line in enumerate(lines, 1):
        if not line.endswith("\n"):
            break
        try:
            row = parse_json(line)
            step, value = float(row["step"]), row.get(metric)
            value = value if value is None else float(value)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise UserError(f"{path}, line {number} is no row of metrics: {error}; {REMEDY}.") from error
        if value is not None:
            steps.append(step)
            values.append(value)
    return np.array(steps, float), np.array(values, float)
