"""A number of a policy with its 95% interval, from one number an episode.

Columns are (n,), or (S, n) where S training seeds met the same n starts; `bootstrap` says what the intervals are then.
"""

import math

import numpy as np
import scipy

from imfvla.reporting.statistics.bootstrap import TAILS, bootstrap
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.statistics.resampling import OfMeans, OfOrdered, Statistic, middle, trimmed

FEWEST_TRAININGS = 3  # that an interval of times is over


def mean(values: np.ndarray) -> Measured:
    return _located(MEAN, values)


def median(values: np.ndarray) -> Measured:
    return _located(MEDIAN, values)


def interquartile_mean(values: np.ndarray) -> Measured:
    """Mean without the lowest and the highest quarter, each rounded down (R. Agarwal et al., arXiv:2108.13264)."""
    return _located(INTERQUARTILE_MEAN, values)


def pooled_mean(totals: np.ndarray, counts: np.ndarray) -> Measured:
    """Mean of positive numbers of which episodes have several each, such as the times of their replannings.

    The interval is over episodes and found on logarithms. It is over training seeds too from three on: two say so
    little about a third that the interval of a time, which hardly depends on the weights, would reach from a tenth of
    it to ten times. Measured(None) without any number.
    """
    if not np.sum(counts):
        return Measured(None)
    is_sample = len(np.atleast_2d(totals)) >= FEWEST_TRAININGS
    return bootstrap(POOLED_MEAN, (totals, counts), over_seeds=is_sample).exponential


def share(happened: np.ndarray) -> Measured:
    """Share of episodes in which something happened, with Wilson's interval.

    Of several training seeds: of as many episodes as would vary as much if all were independent, at most all of them
    (N. Dean and M. Pagano, J. Surv. Stat. Methodol. 3, 2015), with Student's t; of one seed's where nothing varies.
    """
    happened = np.atleast_2d(happened)
    value = float(happened.mean())
    if len(happened) == 1:
        return Measured(value, *wilson_interval(int(happened.sum()), happened.size))
    found = bootstrap(MEAN, happened)
    trials, score = happened.shape[1], float(scipy.special.ndtri(TAILS[1]))
    if found.error:
        trials = min(value * (1 - value) / found.error**2, happened.size)
        score = float(scipy.special.stdtrit(found.freedom, TAILS[1]))
    return Measured(value, *wilson_interval(value * trials, trials, score))


def share_difference(ours: np.ndarray, theirs: np.ndarray) -> Measured:
    """Difference of the shares of two policies' successes (n,) in pairs, with an interval from Wilson's two.

    Method 10 of R. Newcombe, Stat. Med. 17 (1998) 2635: the distances of both shares to their limits, added with the
    correlation of the pairs. Unlike a bootstrap, it allows for a difference where both always succeeded.
    """
    ours, theirs = np.asarray(ours, bool), np.asarray(theirs, bool)
    number, wins, their_wins = ours.size, int(ours.sum()), int(theirs.sum())
    both, neither = int((ours & theirs).sum()), int((~ours & ~theirs).sum())
    covariance = both * neither - (wins - both) * (their_wins - both)
    if covariance > 0:
        covariance = max(covariance - number / 2, 0)
    margins = wins * (number - wins) * their_wins * (number - their_wins)
    correlation = covariance / math.sqrt(margins) if margins else 0.0
    value, their_value = wins / number, their_wins / number
    low, high = wilson_interval(wins, number)
    their_low, their_high = wilson_interval(their_wins, number)

    def distance(ours: float, theirs: float) -> float:
        return math.sqrt(ours**2 - 2 * correlation * ours * theirs + theirs**2)

    difference = value - their_value
    return Measured(
        difference,
        difference - distance(value - low, their_high - their_value),
        difference + distance(high - value, their_value - their_low),
    )


def _located(statistic: Statistic, values: np.ndarray) -> Measured:
    """With few training seeds an interval is stretched: of numbers that are never negative, no further than to 0.

    Nor beyond 0 of numbers that are never positive.
    """
    found = bootstrap(statistic, values).measured
    low, high = found.low, found.high
    if low is None or high is None:
        return found
    return Measured(
        found.value,
        max(low, 0.0) if np.min(values) >= 0 else low,
        min(high, 0.0) if np.max(values) <= 0 else high,
    )


def trimmed_mean(values: np.ndarray) -> np.float64:
    """The value of `interquartile_mean`."""
    cut = int(0.25 * values.size)
    return np.mean(np.sort(values)[cut : values.size - cut])


def log_pooled_mean(totals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The statistic of `pooled_mean`, from the means of both."""
    return np.log(totals) - np.log(counts)


MEAN, POOLED_MEAN = OfMeans(lambda mean: mean), OfMeans(log_pooled_mean)
MEDIAN, INTERQUARTILE_MEAN = OfOrdered(middle), OfOrdered(trimmed)


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a share (default 95%), within [0, 1] (E. B. Wilson, JASA 22, 1927)."""
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"Wanted 0 <= successes <= trials and trials >= 1, found {successes} of {trials}.")
    share = successes / trials
    centre = share + z**2 / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    scale = 1 + z**2 / trials
    low = 0.0 if successes == 0 else (centre - spread) / scale
    high = 1.0 if successes == trials else (centre + spread) / scale
    return low, high
