"""What it costs that files are forced to disk before they count."""

import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

from imfvla.training.logger import MetricsLogger
from imfvla.training.loop import Trainer

SAVES = 3


@dataclass
class Forced:
    """Time spent in `os.fsync` so far."""

    calls: int = 0
    seconds: float = 0.0


@contextmanager
def forcing() -> Iterator[Forced]:
    """Counts and times `os.fsync` of this process."""
    found, original = Forced(), os.fsync

    def timed(descriptor: Any) -> None:
        began = time.perf_counter()
        original(descriptor)
        found.seconds += time.perf_counter() - began
        found.calls += 1

    os.fsync = timed
    try:
        yield found
    finally:
        os.fsync = original


def measure_saving(trainer: Trainer) -> dict[str, float]:
    """The time of saving a row, a state and weights [ms], what forcing them to disk takes of it, and its share.

    The share is that of a training that saves all three once in `training.save_every_s`.
    """
    with closing(MetricsLogger(trainer.run, 0)) as logger, forcing() as forced:
        began = time.perf_counter()
        for step in range(SAVES):
            logger.add({"loss": 0.0})
            logger.write(step + 1)
            trainer._save_state(logger)
            trainer._save_weights()
        took_s = time.perf_counter() - began
    return {
        "saving_ms": 1e3 * took_s / SAVES,
        "forcing_ms": 1e3 * forced.seconds / SAVES,
        "forcing_share": forced.seconds / SAVES / trainer.options.save_every_s,
    }
