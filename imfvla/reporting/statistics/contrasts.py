"""Two policies compared start by start: differences and ratios, their intervals, and the smallest that would show."""

import math
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import scipy

from imfvla.reporting.rows import TIMING
from imfvla.reporting.statistics.bootstrap import Bootstrapped, bootstrap
from imfvla.reporting.statistics.estimates import log_pooled_mean, share_difference
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.statistics.pairs import Pairs
from imfvla.reporting.statistics.power import detectable_difference, detectable_share_difference
from imfvla.reporting.statistics.resampling import OfMeans
from imfvla.reporting.statistics.significance import mcnemar, sign_flip, signed_rank

# experiments/protocol.md says which of them is used where
MCNEMAR, SIGN_FLIP, SEEDS = "exact McNemar", "sign flip", "sign flip, and t over training seeds"


@dataclass(frozen=True, slots=True)
class Contrast:
    """A difference or a ratio of two policies: 0 or 1 where they are alike, more where ours is better.

    `p` is two-sided, by `test`. `detectable` is the smallest `result` in our favour that so many pairs would have shown
    with probability 0.8 (`power`); None where there is none.
    """

    result: Measured
    p: float | None
    test: str
    detectable: float | None


def success_difference(pairs: Pairs) -> Contrast:
    """Ours less theirs, as shares, with Newcombe's interval for pairs and the exact McNemar test.

    With several training seeds: bootstrap, and the tests of `return_difference`.
    """
    ours, theirs = pairs.columns(itemgetter("success"))
    if max(len(ours), len(theirs)) > 1:
        return _difference(pairs, ours, theirs)
    ours, theirs = ours[0] > 0, theirs[0] > 0
    detectable = detectable_share_difference(ours.size, float(np.mean(ours != theirs)))
    return Contrast(share_difference(ours, theirs), mcnemar(ours, theirs), MCNEMAR, detectable)


def return_difference(pairs: Pairs) -> Contrast:
    """Ours less theirs, as mean returns, with an interval by `bootstrap` over pairs and the sign-flip test.

    With several training seeds, these are a sample too: p is then the greater one of that test, of the seeds' means by
    start, and of Student's t with the error and the degrees of freedom of the bootstrap.
    """
    return _difference(pairs, *pairs.columns(itemgetter("total_reward")))


def return_ratio(pairs: Pairs) -> Contrast:
    """Ours over theirs, as mean returns, with an interval by `bootstrap` over pairs; p is of `return_difference`.

    Found on logarithms. Infinite where the mean of theirs is 0, None where ours is 0 too.
    """
    return _ratio(pairs, "total_reward", return_difference(pairs))


def success_ratio(pairs: Pairs) -> Contrast:
    """As `return_ratio`, of success shares; p is of `success_difference`."""
    return _ratio(pairs, "success", success_difference(pairs))


def return_ranks(pairs: Pairs) -> float:
    """p of the signed-rank test of the returns, of the means over training seeds by start.

    It decides nothing. `experiments/protocol.md` named it until 27 November 2026, so that it is reported beside the
    test of `return_difference`.
    """
    ours, theirs = pairs.columns(itemgetter("total_reward"))
    return signed_rank(ours.mean(axis=0) - theirs.mean(axis=0))


def speedup(pairs: Pairs) -> Contrast:
    """Theirs over ours, as mean times of a chunk, which is the ratio of the rates, ours over theirs.

    The interval is over pairs of episodes, the sign-flip test of the logarithms of their mean times. None where
    one of them has no time.
    """
    counts = pairs.columns(lambda row: len(row[TIMING]["inference_ms"]))
    totals = pairs.columns(lambda row: sum(row[TIMING]["inference_ms"]))
    ours, theirs = zip(totals, counts, strict=True)
    found = bootstrap(LOG_SPEEDUP, *pairs.policies(ours, theirs))
    if not np.isfinite(found.value):
        return Contrast(Measured(None), None, SIGN_FLIP, None)
    timed = np.all([np.all(count > 0, axis=0) for count in counts], axis=0)
    logs = [np.log(total[:, timed] / count[:, timed]) for total, count in (theirs, ours)]
    p, test = _p_value(*logs, found)
    return Contrast(found.exponential, p, test, _detectable_ratio(found))


def _difference(pairs: Pairs, ours: np.ndarray, theirs: np.ndarray) -> Contrast:
    found = bootstrap(MEAN_DIFFERENCE, *pairs.policies((ours,), (theirs,)))
    p, test = _p_value(ours, theirs, found)
    detectable = detectable_difference(found.error, found.freedom) if found.error else None
    return Contrast(found.measured, p, test, detectable)


def _ratio(pairs: Pairs, key: str, tested: Contrast) -> Contrast:
    ours, theirs = pairs.columns(itemgetter(key))
    found = bootstrap(LOG_RATIO, *pairs.policies((ours,), (theirs,)))
    return Contrast(found.exponential, tested.p, tested.test, _detectable_ratio(found))


def _p_value(ours: np.ndarray, theirs: np.ndarray, found: Bootstrapped) -> tuple[float, str]:
    p = sign_flip(ours.mean(axis=0) - theirs.mean(axis=0))
    if max(len(ours), len(theirs)) == 1:
        return p, SIGN_FLIP
    of_seeds = (
        2 * float(scipy.special.stdtr(found.freedom, -abs(found.value) / found.error)) if found.error else p
    )
    return max(p, of_seeds), SEEDS


def _detectable_ratio(found: Bootstrapped) -> float | None:
    if not found.error or not np.isfinite(found.error):
        return None
    return math.exp(detectable_difference(found.error, found.freedom))


def _log_ratio(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    return np.log(ours) - np.log(theirs)


def _log_speedup(
    ours: np.ndarray, our_counts: np.ndarray, theirs: np.ndarray, their_counts: np.ndarray
) -> np.ndarray:
    return log_pooled_mean(theirs, their_counts) - log_pooled_mean(ours, our_counts)


MEAN_DIFFERENCE, LOG_RATIO, LOG_SPEEDUP = OfMeans(np.subtract), OfMeans(_log_ratio), OfMeans(_log_speedup)
