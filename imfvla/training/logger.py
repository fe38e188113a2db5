"""Metrics of a training run: one row of means per interval in metrics.jsonl, and the same in TensorBoard."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.storage.appended import AppendedFile
from imfvla.storage.files import write_text
from imfvla.storage.metrics import read_metrics
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.tensorboard import EventFile


class MetricsLogger:
    """Averages scalars over the steps between rows.

    After a kill, rows later than the resumed step are cut off, so that every step has one row; with the sums
    that `state` returns, the first row after resuming equals the one of an uninterrupted run.
    """

    def __init__(self, run: RunDirectory, resumed_step: int, state: Mapping[str, Any] | None = None) -> None:
        _truncate(run.metrics, resumed_step)
        self._file = AppendedFile(run.metrics)
        self._events = EventFile(run.tensorboard, resumed_step + 1)
        self._sums: dict[str, float] = dict(state["sums"]) if state else {}
        self._count: int = state.get("count", 0) if state else 0
        self._skipped: int = state.get("skipped", 0) if state else 0

    def add(self, scalars: Mapping[str, float]) -> None:
        """Adds the scalars of one step."""
        for name, value in scalars.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value)
        self._count += 1

    def skip(self) -> None:
        """Counts a skipped step; its row has their number."""
        self._skipped += 1

    def write(self, step: int, **extra: float) -> None:
        """Writes one row: the means since the last row, and `extra` unchanged."""
        row = {name: total / self._count for name, total in self._sums.items()} | extra
        if self._skipped:
            row["skipped"] = self._skipped
        self._file.write((json.dumps({"step": step, **row}) + "\n").encode("utf-8"))
        self._events.add(row, step)
        self._sums, self._count, self._skipped = {}, 0, 0

    def sync(self) -> None:
        """Forces the rows to disk, before a state counts that follows them. TensorBoard's files are left out."""
        self._file.sync()

    def state(self) -> dict[str, Any]:
        """Sums of the interval that has begun; JSON-able."""
        return {"sums": dict(self._sums), "count": self._count, "skipped": self._skipped}

    def close(self) -> None:
        self._file.sync()
        self._file.close()
        self._events.close()


class SilentLogger(MetricsLogger):
    """The logger of processes that write nothing."""

    def __init__(self, *_: Any) -> None:
        pass

    def add(self, scalars: Mapping[str, float]) -> None:
        pass

    def skip(self) -> None:
        pass

    def write(self, step: int, **extra: float) -> None:
        pass

    def sync(self) -> None:
        pass

    def state(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        pass


def _truncate(path: Path, step: int) -> None:
    """Keeps the rows up to `step`."""
    if path.exists():
        kept = [row for row in read_metrics(path) if row["step"] <= step]
        write_text(path, "".join(json.dumps(row) + "\n" for row in kept))
