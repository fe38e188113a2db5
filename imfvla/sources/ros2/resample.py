"""Messages at their own times become steps of one rate. Times are whole nanoseconds. Shapes: N messages, T steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imfvla.errors import UserError
from imfvla.sources.checks import MAX_STEPS


@dataclass(frozen=True, slots=True)
class Series:
    """The messages of one topic in the order of their times."""

    topic: str
    times: np.ndarray  # int64 (N,)
    order: np.ndarray  # int64 (N,)  which message of the topic each is, as recorded

    @classmethod
    def of(cls, topic: str, times: Sequence[int]) -> "Series":
        recorded = np.array(times, np.int64)
        order = np.argsort(recorded, kind="stable")
        return cls(topic, recorded[order], order)

    @property
    def num_disordered(self) -> int:
        """How many messages are older than the one recorded before."""
        recorded = np.empty_like(self.times)
        recorded[self.order] = self.times
        return int((np.diff(recorded) < 0).sum())


@dataclass(frozen=True, slots=True)
class Steps:
    """Times of the control steps of an episode."""

    start: int
    count: int
    hz: float

    @property
    def times(self) -> np.ndarray:
        """int64 (T,)."""
        return self.start + np.round(np.arange(self.count) * (1e9 / self.hz)).astype(np.int64)


def common_steps(series: Sequence[Series], window: tuple[int, int] | None, hz: float, bag: str) -> Steps:
    """The steps at which every topic has had a message, and none has ended.

    Raises UserError where there is no such time.
    """
    start, end = max(one.times[0] for one in series), min(one.times[-1] for one in series)
    if window is not None:
        start, end = max(start, window[0]), min(end, window[1])
    if end <= start:
        spans = ", ".join(
            f"{one.topic} {one.times[0] / 1e9:.3f} to {one.times[-1] / 1e9:.3f} s" for one in series
        )
        raise UserError(
            f"{bag}: its topics must have a time in common, found {spans}; if some have no header.stamp of the same "
            "clock, set clock: log."
        )
    count = int((int(end) - int(start)) * hz / 1e9 + 1e-6) + 1
    if count > MAX_STEPS:
        raise UserError(
            f"{bag}: an episode must have at most {MAX_STEPS} steps, found {count}; split it with marks."
        )
    return Steps(int(start), count, hz)


def last_before(series: Series, times: np.ndarray) -> np.ndarray:
    """Place of the last message at or before each time: int64 (T,)."""
    return np.searchsorted(series.times, times, "right") - 1


def nearest(series: Series, times: np.ndarray) -> np.ndarray:
    """Place of the message nearest to each time: int64 (T,)."""
    after = np.clip(np.searchsorted(series.times, times), 1, max(1, len(series.times) - 1))
    after = np.minimum(after, len(series.times) - 1)
    before = np.maximum(after - 1, 0)
    is_after = series.times[after] - times < times - series.times[before]
    return np.where(is_after, after, before)


def largest_gap_s(series: Series, times: np.ndarray) -> float:
    """The longest time without a message during these times [s]."""
    first, last = last_before(series, times[[0, -1]])
    within = np.append(series.times[first : last + 1], times[-1])
    return float(np.diff(within).max()) / 1e9
