"""The smallest difference that so many pairs show: with probability 0.8, two-sided at 0.05."""

from functools import lru_cache

import numpy as np
import scipy

ALPHA = 0.05
POWER = 0.8


@lru_cache(maxsize=256)
def detectable_share_difference(pairs: int, disagreement: float = 0.5) -> float | None:
    """Smallest difference of two success shares that the exact McNemar test finds; None if it finds none.

    Of n pairs, M ~ Binomial(n, psi) disagree, and of these Binomial(M, (1 + delta / psi) / 2) in favour of the better
    policy; the power is the probability that this number is significant given M. Solved for delta at a power of 0.8
    without approximation; R. Connor's normal one (Biometrics 43, 1987) is
    delta = (z_0.975 sqrt(psi) + z_0.8 sqrt(psi - delta^2)) / sqrt(n).

    Args:
      pairs: n, the episodes of each policy.
      disagreement: psi; a larger difference implies as much disagreement. 0.5 is the worst for policies whose
        successes have nothing to do with each other.
    """

    def excess(difference: float) -> float:
        return mcnemar_power(pairs, max(disagreement, difference), difference) - POWER

    if excess(1.0) < 0:
        return None
    return float(scipy.optimize.brentq(excess, 0.0, 1.0, xtol=1e-6))


def mcnemar_power(pairs: int, disagreement: float, difference: float) -> float:
    """Probability that the exact McNemar test is significant, for psi = `disagreement` and delta = `difference`."""
    number, most = np.arange(pairs + 1), _most_successes(pairs)
    better = 0.5 + 0.5 * difference / disagreement if disagreement else 0.5
    significant = _at_most(most, number, 1 - better) + _at_most(most, number, better)
    ways = (
        scipy.special.gammaln(pairs + 1)
        - scipy.special.gammaln(number + 1)
        - scipy.special.gammaln(pairs - number + 1)
    )
    chance = (
        ways
        + scipy.special.xlogy(number, disagreement)
        + scipy.special.xlog1py(pairs - number, -disagreement)
    )
    return float(np.exp(chance) @ significant)


@lru_cache(maxsize=8)
def _most_successes(pairs: int) -> np.ndarray:
    """Of the worse side up to which a result is significant, -1 for none, where 0 to `pairs` disagree."""
    number = np.arange(pairs + 1)
    most = np.floor(np.nan_to_num(scipy.special.bdtrik(ALPHA / 2, number, 0.5), nan=-1.0))
    most += _at_most(most + 1, number, 0.5) <= ALPHA / 2  # it is right but for rounding
    return most - (_at_most(most, number, 0.5) > ALPHA / 2)


def _at_most(successes: np.ndarray, trials: np.ndarray, share: float) -> np.ndarray:
    """Binomial probability of at most so many successes."""
    found = scipy.special.bdtr(np.clip(successes, 0, trials), trials, share)
    return np.where(successes < 0, 0.0, found)


def detectable_difference(error: float, freedom: float = np.inf) -> float:
    """Smallest difference of means that is found: (t_0.975 + t_0.8) times its standard error.

    Args:
      error: of the difference; s / sqrt(n) for n pairs whose differences have the standard deviation s.
      freedom: degrees of freedom of t.
    """
    return float(
        (scipy.special.stdtrit(freedom, 1 - ALPHA / 2) + scipy.special.stdtrit(freedom, POWER)) * error
    )
