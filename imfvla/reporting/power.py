"""The smallest difference that so many pairs show: with probability 0.8, two-sided at 0.05."""

import numpy as np
import scipy

ALPHA = 0.05
POWER = 0.8


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
    number = np.arange(pairs + 1)  # of pairs that disagree
    # successes of the worse side up to which a result is significant; sometimes one too many, corrected below
    most = scipy.stats.binom.ppf(ALPHA / 2, number, 0.5)
    most -= scipy.stats.binom.cdf(most, number, 0.5) > ALPHA / 2
    better = 0.5 + 0.5 * difference / disagreement if disagreement else 0.5
    significant = scipy.stats.binom.cdf(most, number, 1 - better) + scipy.stats.binom.cdf(
        most, number, better
    )
    return float(scipy.stats.binom.pmf(number, pairs, disagreement) @ significant)


def detectable_difference(error: float, freedom: float = np.inf) -> float:
    """Smallest difference of means that is found: (t_0.975 + t_0.8) times its standard error.

    Args:
      error: of the difference; s / sqrt(n) for n pairs whose differences have the standard deviation s.
      freedom: degrees of freedom of t.
    """
    return float((scipy.stats.t.ppf(1 - ALPHA / 2, freedom) + scipy.stats.t.ppf(POWER, freedom)) * error)
