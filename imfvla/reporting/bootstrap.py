"""Bootstrap intervals, over episodes and, where a policy was trained several times, over training seeds too.

Columns are numbers by episode: (n,) of one policy or (S, n) of S training seeds from the same n starts. A statistic
takes columns and `axis`, as numpy's own do, and works on many resamples at once.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from imfvla.reporting.measured import Measured

RESAMPLES = 10_000
LEVEL = 0.95
TAILS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
NUMBERS_AT_ONCE = 4_000_000  # bounds the memory of a hierarchical bootstrap to a few arrays of 32 MB

Statistic = Callable[..., np.ndarray]


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
        """For a statistic that is a logarithm."""
        numbers = (self.value, self.low, self.high)
        return Measured(*(None if number is None else float(np.exp(number)) for number in numbers))


def bootstrap(statistic: Statistic, *columns: np.ndarray) -> Bootstrapped:
    """A statistic of paired columns, all (n,) or all (S, n), with an interval from 10,000 resamples of a fixed generator.

    Of one training seed: BCa over episodes (B. Efron, JASA 82, 1987), and percentiles where the acceleration is not
    defined, as for a median that no single episode moves. Of S > 1: `_hierarchical`. Equal numbers throughout give a point; one episode
    or a value that is not finite has no interval.
    """
    columns = tuple(np.atleast_2d(np.asarray(column, float)) for column in columns)
    if len({column.shape for column in columns}) != 1 or not columns[0].size:
        raise ValueError(
            f"Wanted columns of one shape, not empty, found {[column.shape for column in columns]}."
        )
    seeds, starts = columns[0].shape
    with np.errstate(all="ignore"):
        value = float(statistic(*(column.ravel() for column in columns), axis=-1))
        if starts < 2 or not np.isfinite(value):
            return Bootstrapped(value)
        if all(np.ptp(column) == 0 for column in columns):
            return Bootstrapped(value, value, value, 0.0)
        if seeds > 1:
            return _hierarchical(statistic, columns, value)
        return _accelerated(statistic, [column[0] for column in columns], value)


def _accelerated(statistic: Statistic, columns: list[np.ndarray], value: float) -> Bootstrapped:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is degenerate is handled below
        found = stats.bootstrap(
            columns, statistic, paired=True, n_resamples=RESAMPLES, confidence_level=LEVEL, method="BCa",
            rng=np.random.default_rng(0),
        )  # fmt: skip
    low, high = found.confidence_interval
    distribution = found.bootstrap_distribution
    if not np.isfinite([low, high]).all():
        low, high = _percentiles(distribution)
    return Bootstrapped(value, float(low), float(high), float(np.std(distribution, ddof=1)))


def _hierarchical(statistic: Statistic, columns: tuple[np.ndarray, ...], value: float) -> Bootstrapped:
    """Training seeds and starts are drawn independently, as every seed met the same starts (A. Owen, Ann. Appl. Stat. 1, 2007).

    S - 1 of S seeds are drawn, which makes the variance between seeds unbiased (J. Rao and C. Wu, JASA 83, 1988), and
    percentiles are stretched from the normal to Student's t, for S is small: its degrees of freedom are Satterthwaite's from
    the variances over seeds alone and over starts alone.
    """
    seeds, starts = columns[0].shape
    rng = np.random.default_rng(0)
    both = _drawn(statistic, columns, rng, over_seeds=True, over_starts=True)
    of_seeds = np.var(_drawn(statistic, columns, rng, over_seeds=True, over_starts=False))
    of_starts = np.var(_drawn(statistic, columns, rng, over_seeds=False, over_starts=True))
    variance = np.var(both, ddof=1)
    freedom = variance**2 / (of_seeds**2 / (seeds - 1) + of_starts**2 / (starts - 1))
    freedom = float(freedom) if np.isfinite(freedom) else np.inf
    stretch = stats.t.ppf(TAILS[1], freedom) / stats.norm.ppf(TAILS[1])
    low, high = (value + stretch * (end - value) for end in _percentiles(both))
    return Bootstrapped(value, float(low), float(high), float(np.sqrt(variance)), freedom)


def _drawn(
    statistic: Statistic,
    columns: tuple[np.ndarray, ...],
    rng: np.random.Generator,
    *,
    over_seeds: bool,
    over_starts: bool,
) -> np.ndarray:
    """The statistic of each resample, (RESAMPLES,)."""
    seeds, starts = columns[0].shape
    block = max(1, NUMBERS_AT_ONCE // (seeds * starts))
    found = []
    for first in range(0, RESAMPLES, block):
        number = min(block, RESAMPLES - first)
        rows = rng.integers(0, seeds, (number, seeds - 1)) if over_seeds else np.arange(seeds)[None]
        places = rng.integers(0, starts, (number, starts)) if over_starts else np.arange(starts)[None]
        drawn = (column[rows[:, :, None], places[:, None, :]].reshape(number, -1) for column in columns)
        found.append(statistic(*drawn, axis=-1))
    return np.concatenate(found)


def _percentiles(distribution: np.ndarray) -> tuple[float, float]:
    """Outer ends, without interpolation, since some may be infinite; resamples without any value do not count."""
    known = distribution[~np.isnan(distribution)]
    return np.quantile(known, TAILS[0], method="lower"), np.quantile(known, TAILS[1], method="higher")
