"""Two-sided tests of paired episodes, and their correction over a table."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
import scipy

MOST_EXACT = 16  # pairs that differ; with more, sign flips are drawn
FLIPS = 100_000
MOST_KEPT = 128  # pairs whose flips are drawn once for all tests


def mcnemar(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Exact p-value of McNemar's test: pairs (n,) in which only one policy succeeds are as often ours as theirs.

    Conditional and binomial (Q. McNemar, Psychometrika 12, 1947); 1 where no pair differs.
    """
    ours, theirs = np.asarray(ours, bool), np.asarray(theirs, bool)
    only_ours, only_theirs = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    if only_ours + only_theirs == 0:
        return 1.0
    return min(1.0, 2 * float(scipy.special.bdtr(min(only_ours, only_theirs), only_ours + only_theirs, 0.5)))


def sign_flip(differences: np.ndarray) -> float:
    """p-value of the permutation test of paired differences (n,): were both alike, either sign would be equally likely.

    The statistic is the mean (R. Fisher, The Design of Experiments, 1935). Exact up to 16 pairs that differ, else from
    100,000 flips of a fixed generator, the observed one counted in, so that it is never 0.
    """
    differences = np.asarray(differences, float)
    sizes = np.abs(differences[differences != 0])
    least = abs(differences.sum()) - 1e-12 * sizes.sum()  # equal sums differ in rounding
    if sizes.size <= MOST_EXACT:
        bits = np.arange(2**sizes.size)[:, None] >> np.arange(sizes.size) & 1
        return float((np.abs(2 * bits @ sizes - sizes.sum()) >= least).mean())
    extreme = sum(np.count_nonzero(np.abs(2 * sums - sizes.sum()) >= least) for sums in _flipped(sizes))
    return (extreme + 1) / (FLIPS + 1)


def signed_rank(differences: np.ndarray) -> float:
    """p-value of F. Wilcoxon's signed-rank test (Biometrics Bulletin 1, 1945) of paired differences (n,).

    It is `sign_flip` of their ranks by size, equal sizes sharing the mean of their ranks; pairs without a difference
    are left out. It asks about the middle of the differences, not about their mean.
    """
    differences = np.asarray(differences, float)
    differences = differences[differences != 0]
    _, place, counts = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2
    return sign_flip(np.sign(differences) * ranks[place])


def _flipped(sizes: np.ndarray) -> Iterator[np.ndarray]:
    """For each flip, the sum of the sizes that it leaves positive, in some parts."""
    if sizes.size <= MOST_KEPT:
        for bits in _bits()[: FLIPS * sizes.size].reshape(-1, FLIPS // 10, sizes.size):
            yield bits @ sizes
        return
    # The signs of eight pairs are a byte, and a table has the sum of each byte.
    rng, sums = np.random.default_rng(0), np.zeros(FLIPS)
    signs = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
    for first in range(0, sizes.size, 8):
        eight = sizes[first : first + 8]
        sums += (signs[:, : eight.size] @ eight)[rng.integers(0, 256, FLIPS, dtype=np.uint8)]
    yield sums


@lru_cache(maxsize=1)
def _bits() -> np.ndarray:
    """Those of up to `MOST_KEPT` pairs, which all begin with the same."""
    return np.random.default_rng(0).integers(0, 2, FLIPS * MOST_KEPT, dtype=np.int8)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Each p-value corrected for all of them (S. Holm, Scand. J. Stat. 6, 1979); None where there is none."""
    known = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    highest = 0.0
    for rank, (p, place) in enumerate(known):
        highest = max(highest, min(1.0, p * (len(known) - rank)))
        corrected[place] = highest
    return corrected
