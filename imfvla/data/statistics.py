"""Ranges and moments to which normalisers are fitted.

Shapes: T control steps of an episode, K decisions, W windows, Tp predicted steps, S state, A action.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

MOST_BLOCK = 64  # steps that a block of `_Correlation` has at most


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """What a policy's normalisers need, float32.

    Of states (S,) and clean actions (A,): over all recorded control steps. Of displacements (Tp, A), the actions of a
    chunk less the state channels that they are relative to, as these are at its decision: over all windows, steps past
    an episode's end left out. Those of absolute channels mean nothing.
    """

    state_min: np.ndarray
    state_max: np.ndarray
    state_mean: np.ndarray
    state_std: np.ndarray
    action_min: np.ndarray
    action_max: np.ndarray
    action_mean: np.ndarray
    action_std: np.ndarray
    displacement_mean: np.ndarray
    displacement_std: np.ndarray

    @classmethod
    def of(
        cls, state: np.ndarray, action: np.ndarray, displacement: np.ndarray, valid: np.ndarray
    ) -> "Statistics":
        """Statistics of states (T, S), actions (T, A) and displacements (W, Tp, A), valid (W, Tp)."""
        per_step = (moment for rows in (state, action) for moment in _moments(rows))
        counted = valid[..., None]
        number = np.maximum(counted.sum(axis=0), 1)  # a step that is never valid gets mean and deviation 0
        mean = (displacement * counted).sum(axis=0, dtype=np.float64) / number
        variance = (np.square(displacement - mean) * counted).sum(axis=0) / number
        return cls(*per_step, mean.astype(np.float32), np.sqrt(variance).astype(np.float32))

    def to_json(self) -> dict[str, list]:
        """Lists of numbers by field; `from_json` gives equal arrays back."""
        return {name: values.tolist() for name, values in asdict(self).items()}

    @classmethod
    def from_json(cls, lists: Mapping[str, list]) -> "Statistics":
        """Inverse of `to_json`."""
        return cls(**{name: np.asarray(values, np.float32) for name, values in lists.items()})


class RunningStatistics:
    """`Statistics` of episodes that are added one after the other, in memory that does not grow with their number.

    Sums are float64, over values less those of the first episode's first step, so that little is lost where
    deviations are small beside means. A displacement's square is summed as a^2 - 2 a s + s^2, of which only the
    product of action and earlier state depends on pairs of steps; `_Correlation` has it as products of matrices.
    """

    def __init__(self, origin: np.ndarray, pred: int) -> None:
        """`origin` (A,): of each action the state channel that it is displaced from; `pred`: Tp."""
        self._origin, self._pred = origin, pred
        self._steps: tuple[_StepSums, _StepSums] | None = None
        self._count = np.zeros(pred, np.int64)  # windows whose step is valid
        self._sum, self._square = np.zeros((2, len(origin), pred))
        # What is missing in these two sums: of actions and their squares after decisions, of action times state.
        self._sparse, self._sparse_square, self._crossed = (_Correlation(len(origin), pred) for _ in range(3))

    def add(self, state: np.ndarray, action: np.ndarray, decisions: np.ndarray) -> None:
        """An episode of states (T, S) and actions (T, A), with windows at the steps `decisions` (K,), ascending."""
        if self._steps is None:
            self._steps = _StepSums(state[0]), _StepSums(action[0])
            self._usual = action[0].astype(np.float64) - state[0, self._origin]
        state, action = (np.ascontiguousarray(rows.T, np.float64) for rows in (state, action))
        for sums, rows in zip(self._steps, (state, action), strict=True):
            sums.add(rows)
        decided = np.zeros(action.shape[1])
        decided[decisions] = 1
        start = state[self._origin, :1]  # any value, subtracted from both, keeps the products small
        state = (state[self._origin] - start) * decided
        action = action - (start + self._usual[:, None])
        # Of a decision, the step j steps later is valid if the decision lies so far before the end.
        self._count += _suffix_sums(decided[None, ::-1], self._pred)[0].astype(np.int64)
        self._sum -= _suffix_sums(state[:, ::-1], self._pred)
        self._square += _suffix_sums(np.square(state)[:, ::-1], self._pred)
        self._crossed.add(state, action)
        if len(decisions) == len(decided):
            self._sum += _suffix_sums(action, self._pred)
            self._square += _suffix_sums(np.square(action), self._pred)
        else:
            self._sparse.add(decided, action)
            self._sparse_square.add(decided, np.square(action))

    def result(self) -> Statistics:
        """Of all episodes so far, at least one. A step that is never valid has mean and deviation 0."""
        assert self._steps is not None
        number = np.maximum(self._count, 1)
        mean = (self._sum + self._sparse.sums()) / number
        square = (self._square + self._sparse_square.sums() - 2 * self._crossed.sums()) / number
        deviation = np.sqrt(np.maximum(square - np.square(mean), 0))
        mean = np.where(self._count > 0, mean + self._usual[:, None], 0)
        moments = (moment for sums in self._steps for moment in sums.moments())
        return Statistics(*moments, mean.T.astype(np.float32), deviation.T.astype(np.float32))


class _StepSums:
    """Of the rows of one array, whose first row is `first` (C,)."""

    def __init__(self, first: np.ndarray) -> None:
        self._first = first.astype(np.float64)
        self._low, self._high = self._first, self._first
        self._count, self._sum, self._square = 0, np.zeros(len(first)), np.zeros(len(first))

    def add(self, rows: np.ndarray) -> None:
        """`rows` float64 (C, T)."""
        self._low, self._high = (
            np.minimum(self._low, rows.min(axis=1)),
            np.maximum(self._high, rows.max(axis=1)),
        )
        rows = rows - self._first[:, None]
        self._count += rows.shape[1]
        self._sum += rows.sum(axis=1)
        self._square += np.square(rows).sum(axis=1)

    def moments(self) -> tuple[np.ndarray, ...]:
        """Lowest, highest, mean and deviation, float32 (C,)."""
        mean = self._sum / self._count
        deviation = np.sqrt(np.maximum(self._square / self._count - np.square(mean), 0))
        found = (self._low, self._high, self._first + mean, deviation)
        return tuple(moment.astype(np.float32) for moment in found)


def _suffix_sums(values: np.ndarray, count: int) -> np.ndarray:
    """Sums of values (C, T) from steps 0, 1, ... `count` - 1 to the end: (C, count), 0 where there is no such step."""
    sums = np.zeros((len(values), count))
    first = values[:, :count]
    sums[:, : first.shape[1]] = values.sum(axis=1, keepdims=True) - first.cumsum(axis=1) + first
    return sums


class _Correlation:
    """Sums over episodes and steps t of early[:, t] * late[:, t + j] for j below `count`, with 0 past the end.

    Cut into blocks of steps, these are diagonals of the product of two matrices for each channel.
    """

    def __init__(self, channels: int, count: int) -> None:
        self._count, self._size = count, min(count, MOST_BLOCK)
        # The product has its own memory: the system takes as long to hand it out each time as to compute it.
        self._products, self._sum = np.zeros((2, channels, self._size, self._size + count))

    def add(self, early: np.ndarray, late: np.ndarray) -> None:
        """An episode's values, float64 (C, T) each; `early` may broadcast to it."""
        (channels, steps), size = late.shape, self._size
        blocks = -(-steps // size)
        left = np.zeros((channels, blocks * size))
        left[:, :steps] = early
        right = np.zeros((channels, blocks * size + self._count))
        right[:, :steps] = late
        shape = channels, blocks, size + self._count
        right = as_strided(right, shape, (right.strides[0], size * right.strides[1], right.strides[1]))
        left = left.reshape(channels, blocks, size).transpose(0, 2, 1)
        self._sum += np.matmul(left, np.ascontiguousarray(right), out=self._products)

    def sums(self) -> np.ndarray:
        """float64 (C, count)."""
        channel, row, column = self._sum.strides
        shape = len(self._sum), self._size, self._count
        return as_strided(self._sum, shape, (channel, row + column, column)).sum(axis=1)


def _moments(rows: np.ndarray) -> tuple[np.ndarray, ...]:
    rows = rows.astype(np.float64)
    moments = (rows.min(axis=0), rows.max(axis=0), rows.mean(axis=0), rows.std(axis=0))
    return tuple(moment.astype(np.float32) for moment in moments)
