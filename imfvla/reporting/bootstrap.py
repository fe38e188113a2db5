"""Bootstrap intervals, over episodes and, where a policy was trained several times, over training seeds too.

A column holds a number for each episode: (n,) of one policy, or (S, n) of S training seeds from the same n starts. A
statistic takes columns and `axis`, as numpy's own do, and works on many resamples at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from imfvla.reporting.measured import Measured

RESAMPLES = 10_000
RESAMPLES_OF_PARTS = 2_000  # where only a variance is needed, for the degrees of freedom
TAILS = (0.025, 0.975)
# An interval within the range of n numbers holds the middle of what they are drawn from with a probability of at most
# 1 - 2^(1 - n), which is 95% from 6 on.
FEWEST_STARTS = 6
NUMBERS_AT_ONCE = 2_000_000  # bounds what a hierarchical bootstrap needs to some arrays of 16 MB

Statistic = Callable[..., np.ndarray]
Columns = tuple[np.ndarray, ...]


@dataclass(frozen=True, slots=True)
class Counted:
    """A statistic of one column that is found sooner from how often each of its numbers was drawn.

    `counted` takes the column (n,) and counts (n, resamples), each resample's n in sum.
    """

    of: Callable[..., np.ndarray]
    counted: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def __call__(self, values: np.ndarray, axis: int = -1) -> np.ndarray:
        return self.of(values, axis=axis)


@dataclass(frozen=True, slots=True)
class Bootstrapped:
    """A statistic, its 95% interval and standard error; `freedom` is of Student's t of value / error."""

    value: float
    low: float | None = None
    high: float | None = None
    error: float | None = None
    freedom: float = np.inf

    @property
    def measured(self) -> Measured:
        return Measured(self.value, self.low, self.high)

    @property
    def exponential(self) -> Measured:
        """Of a statistic that is a logarithm; its value is None where it is not a number."""
        numbers = (self.value, self.low, self.high)
        known = (None if number is None or np.isnan(number) else float(np.exp(number)) for number in numbers)
        return Measured(*known)


def bootstrap(statistic: Statistic, *policies: np.ndarray | Columns) -> Bootstrapped:
    """A statistic with an interval from 10,000 resamples of a fixed generator.

    With one training seed a policy: BCa over starts (B. Efron, JASA 82, 1987), and percentiles where the acceleration
    is not defined, as for a median that no single episode moves. With several: `_hierarchical`. Equal numbers
    throughout give a point; fewer than `FEWEST_STARTS`, or a value that is not finite, have no interval.

    Args:
      statistic: takes the columns of all policies, one after the other.
      policies: one column or several, each (n,) or (S, n); of all policies from the same n starts.
    """
    policies = tuple(
        tuple(np.atleast_2d(np.asarray(column, float)) for column in columns)
        for columns in (columns if isinstance(columns, tuple) else (columns,) for columns in policies)
    )
    columns = [column for columns in policies for column in columns]
    lengths = {column.shape[1] for column in columns}
    if len(lengths) != 1 or not all(column.size for column in columns):
        raise ValueError(
            f"The columns must have the same starts, found {[column.shape for column in columns]}."
        )
    return _found(statistic, tuple(tuple(map(_kept, columns)) for columns in policies), RESAMPLES)


Kept = tuple[tuple[int, ...], bytes]  # shape and content of a column


def _kept(column: np.ndarray) -> Kept:
    return column.shape, column.tobytes()


@lru_cache(maxsize=1024)  # a row's numbers are asked for by tables, figures and the row's other numbers
def _found(statistic: Statistic, kept: tuple[tuple[Kept, ...], ...], resamples: int) -> Bootstrapped:
    policies = [tuple(np.frombuffer(held).reshape(shape) for shape, held in columns) for columns in kept]
    columns = [column for columns in policies for column in columns]
    with np.errstate(all="ignore"):
        value = float(statistic(*(column.ravel() for column in columns), axis=-1))
        if columns[0].shape[1] < FEWEST_STARTS or not np.isfinite(value):
            return Bootstrapped(value)
        if all(np.ptp(column) == 0 for column in columns):
            return Bootstrapped(value, value, value, 0.0)
        if max(map(len, columns)) > 1:
            return _hierarchical(statistic, policies, value, resamples)
        return _accelerated(statistic, [column[0] for column in columns], value, resamples)


def _accelerated(
    statistic: Statistic, columns: Sequence[np.ndarray], value: float, resamples: int
) -> Bootstrapped:
    """The numbers of `scipy.stats.bootstrap` with the seed 0, whose draws are here the same for every column."""
    starts = columns[0].size
    distribution = _distribution(statistic, columns, resamples)
    low, high = _bias_corrected(distribution, value, statistic(*map(_each_left_out, columns), axis=-1))
    if not np.isfinite([low, high]).all():
        low, high = _percentiles(distribution)
    error = float(np.std(distribution, ddof=1))
    return Bootstrapped(value, float(low), float(high), error, starts - 1)


def _distribution(statistic: Statistic, columns: Sequence[np.ndarray], resamples: int) -> np.ndarray:
    """The statistic of each resample (resamples,)."""
    starts = columns[0].size
    block = max(1, NUMBERS_AT_ONCE // starts)
    parts = [slice(first, first + block) for first in range(0, resamples, block)]
    if isinstance(statistic, Counted) and all(map(_is_whole, columns)):
        counts = _counts(starts, resamples)
        return np.concatenate([statistic.counted(*columns, counts[:, part]) for part in parts])
    places = _places(starts, resamples)
    return np.concatenate([statistic(*(c[places[part]] for c in columns), axis=-1) for part in parts])


def _is_whole(column: np.ndarray) -> bool:
    """Whether sums of its numbers are exact, in any order."""
    return bool((column == np.rint(column)).all() and np.abs(column).max() < 2**32)


@lru_cache(maxsize=1)
def _counts(starts: int, resamples: int) -> np.ndarray:
    """How often each resample has each start, uint16 (starts, resamples)."""
    places, block = _places(starts, resamples), max(1, NUMBERS_AT_ONCE // starts)
    counts = np.empty((starts, resamples), np.uint16)
    for first in range(0, resamples, block):
        drawn = places[first : first + block].astype(np.int64)
        drawn += starts * np.arange(len(drawn))[:, None]
        of_block = np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape)
        counts[:, first : first + block] = of_block.T
    return counts


@lru_cache(maxsize=1)
def _places(starts: int, resamples: int) -> np.ndarray:
    """The starts of each resample, int32 (resamples, starts)."""
    rng, block = np.random.default_rng(0), max(1, NUMBERS_AT_ONCE // starts)
    places = np.empty((resamples, starts), np.int32)
    for first in range(0, resamples, block):
        rows = places[first : first + block]
        rows[:] = rng.integers(0, starts, rows.shape)
    return places


def _each_left_out(column: np.ndarray) -> np.ndarray:
    """The column (n,) without each of its numbers in turn: (n, n - 1)."""
    kept = ~np.eye(column.size, dtype=bool)
    return np.broadcast_to(column, kept.shape)[kept].reshape(column.size, -1)


def _bias_corrected(distribution: np.ndarray, value: float, left_out: np.ndarray) -> np.ndarray:
    """The BCa interval of the statistic of each resample, its value, and the statistic without each start.

    B. Efron and R. Tibshirani, An Introduction to the Bootstrap, 1993, eq. 14.9 to 14.15.
    """
    lower = np.count_nonzero(distribution < value) + np.count_nonzero(distribution <= value)
    bias = scipy.special.ndtri(lower / (2 * distribution.size))
    number = float(left_out.size)
    influence = (number - 1) * (np.mean(left_out, keepdims=True) - left_out)
    cubes, squares = np.sum(influence**3) / number**3, np.sum(influence**2) / number**2
    acceleration = 1 / 6 * cubes / squares ** (3 / 2)
    moved = bias + np.array([1, -1]) * scipy.special.ndtri((1 - (TAILS[1] - TAILS[0])) / 2)
    shares = scipy.special.ndtr(bias + moved / (1 - acceleration * moved))
    return _quantiles(distribution, shares) if np.isfinite(shares).all() else shares


def _quantiles(distribution: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """With linear interpolation, rounded as `scipy.stats.quantile` does, so that published digits stay."""
    ordered, places = np.sort(distribution), shares * distribution.size + (1 - shares)
    upper, part = np.floor(places), places % 1
    at = [np.clip(place, 0, distribution.size - 1).astype(int) for place in (upper - 1, upper)]
    return (1 - part) * ordered[at[0]] + part * ordered[at[1]]


def _hierarchical(
    statistic: Statistic, policies: Sequence[Columns], value: float, resamples: int
) -> Bootstrapped:
    """Starts and each policy's training seeds are drawn independently, since every seed met the same starts.

    That is the pigeonhole bootstrap (A. Owen, Ann. Appl. Stat. 1, 2007). Of S seeds S - 1 are drawn, which makes the
    variance between seeds unbiased (J. Rao and C. Wu, JASA 83, 1988). As S is small, percentiles are moved away from
    the value in the ratio of Student's t to the normal, with Satterthwaite's degrees of freedom from the variances
    over starts alone and over each policy's seeds alone. A policy with one seed is taken as it is. Simulated intervals
    of a mean cover 93 to 99% with three seeds or more, but 88% with two.
    """
    starts, counts = policies[0][0].shape[1], [len(columns[0]) for columns in policies]
    rng = np.random.default_rng(0)
    several, none = [count > 1 for count in counts], [False] * len(policies)
    both = _drawn(statistic, policies, rng, resamples, over_seeds=several, over_starts=True)
    drawn = _drawn(statistic, policies, rng, RESAMPLES_OF_PARTS, over_seeds=none, over_starts=True)
    parts = [(np.var(drawn), starts - 1)]
    for policy, count in enumerate(counts):
        if count > 1:
            here = [other == policy for other in range(len(policies))]
            drawn = _drawn(statistic, policies, rng, RESAMPLES_OF_PARTS, over_seeds=here, over_starts=False)
            parts.append((np.var(drawn), count - 1))
    variance = np.var(both)
    freedom = variance**2 / sum(part**2 / free for part, free in parts)
    freedom = float(freedom) if np.isfinite(freedom) else np.inf
    stretch = scipy.stats.t.ppf(TAILS[1], freedom) / scipy.stats.norm.ppf(TAILS[1])
    low, high = (float(value + stretch * (end - value)) for end in _percentiles(both))
    return Bootstrapped(value, low, high, float(np.sqrt(variance)), freedom)


def _drawn(
    statistic: Statistic,
    policies: Sequence[Columns],
    rng: np.random.Generator,
    resamples: int,
    *,
    over_seeds: Sequence[bool],
    over_starts: bool,
) -> np.ndarray:
    """The statistic of each resample (resamples,), over the seeds of some policies, over starts, or over both."""
    starts = policies[0][0].shape[1]
    block = max(1, NUMBERS_AT_ONCE // max(columns[0].size for columns in policies))
    found = []
    for first in range(0, resamples, block):
        number = min(block, resamples - first)
        places = rng.integers(0, starts, (number, starts)) if over_starts else np.arange(starts)[None]
        drawn = []
        for columns, draws in zip(policies, over_seeds, strict=True):
            count = len(columns[0])
            seeds = rng.integers(0, count, (number, count - 1)) if draws else np.arange(count)[None]
            where = starts * seeds[:, :, None] + places[:, None, :]
            drawn += [np.broadcast_to(c.ravel()[where], (number, *where.shape[1:])) for c in columns]
        found.append(statistic(*(column.reshape(number, -1) for column in drawn), axis=-1))
    return np.concatenate(found)


def _percentiles(distribution: np.ndarray) -> tuple[float, float]:
    """Outer ends without interpolation, as some may be infinite; resamples without any value do not count."""
    known = distribution[~np.isnan(distribution)]
    return np.quantile(known, TAILS[0], method="lower"), np.quantile(known, TAILS[1], method="higher")
