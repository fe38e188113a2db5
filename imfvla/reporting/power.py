"""The smallest difference that so many pairs show: with probability 0.8, two-sided at 0.05."""

import numpy as np
from scipy import optimize, stats

ALPHA = 0.05
POWER = 0.8


def detectable_share_difference(pairs: int, disagreement: float) -> float | None:
    """Smallest difference of two success shares that the exact McNemar test finds, None where it finds none.

    With n pairs of which a share psi disagrees, M ~ Binomial(n, psi) do, and of these Binomial(M, (1 + delta / psi) / 2)
    are for the better policy; the power is the probability that their number is significant given M. Solved
    for a power of 0.8 exactly, where R. Connor (Biometrics 43, 1987) has the normal approximation
    delta = (z_0.975 sqrt(psi) + z_0.8 sqrt(psi - delta^2)) / sqrt(n).

    Args:
      pairs: n, the episodes of each policy.
      disagreement: psi, in (0, 1]; 0.5 is the worst for policies whose successes have nothing in common.
    """

    def missing(difference: float) -> float:
        return mcnemar_power(pairs, disagreement, difference) - POWER

    if missing(disagreement) < 0:
        return None
    return float(optimize.brentq(missing, 0.0, disagreement, xtol=1e-6))


def mcnemar_power(pairs: int, disagreement: float, difference: float) -> float:
    """Probability that the exact McNemar test is significant, for psi = `disagreement` and delta = `difference`."""
    number = np.arange(pairs + 1)  # of pairs that disagree
    most = stats.binom.ppf(
        ALPHA / 2, number, 0.5
    )  # of the worse side, to be significant; one too many at times
    most -= stats.binom.cdf(most, number, 0.5) > ALPHA / 2
    better = (1 + difference / disagreement) / 2
    significant = stats.binom.cdf(most, number, 1 - better) + stats.binom.cdf(most, number, better)
    return float(stats.binom.pmf(number, pairs, disagreement) @ significant)


def detectable_difference(error: float, freedom: float = np.inf) -> float:
    """Smallest difference of means that is found: (t_0.975 + t_0.8) times its standard error.

    Args:
      error: of the difference; s / sqrt(n) for n pairs whose differences have the standard deviation s.
      freedom: degrees of freedom of t.
    """
    return float((stats.t.ppf(1 - ALPHA / 2, freedom) + stats.t.ppf(POWER, freedom)) * error)
