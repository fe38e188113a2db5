"""Resamples as counts, and statistics that are found from how often each number was drawn.

A column holds a number for each episode, (S, n) of S training seeds from the same n starts. R resamples of starts are
a matrix of counts (n, R): means of all of them are one product, and middles come from running totals of the counts of
the numbers in ascending order, which are sorted once.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

NUMBERS_AT_ONCE = 2_000_000  # bounds what is computed at once to some arrays of 16 MB

Columns = tuple[np.ndarray, ...]


@dataclass(frozen=True, slots=True)
class Draws:
    """How often each resample has each start (n, R), and each training seed of each policy (S, R).

    Either may have one column for all resamples. All resamples have equally many numbers.
    """

    starts: np.ndarray
    seeds: tuple[np.ndarray, ...]

    @property
    def number(self) -> int:
        return max(part.shape[1] for part in (self.starts, *self.seeds))

    def parts(self) -> Iterator["Draws"]:
        """The same draws, as many at once as there is room for."""
        width = _width(len(self.starts), [*map(len, self.seeds)])
        for first in range(0, self.number, width):
            starts, *seeds = (
                counts if counts.shape[1] == 1 else counts[:, first : first + width]
                for counts in (self.starts, *self.seeds)
            )
            yield Draws(starts, tuple(seeds))


Statistic = Callable[
    [Sequence[Columns], Draws], np.ndarray
]  # columns of each policy -> a number for each resample


@dataclass(frozen=True, slots=True)
class OfMeans:
    """A function of the means of all columns, each (R,), policy by policy."""

    of: Callable[..., np.ndarray]

    def __call__(self, policies: Sequence[Columns], draws: Draws) -> np.ndarray:
        starts = draws.starts.astype(float)
        return self.of(
            *(
                _mean(column, starts, seeds)
                for columns, seeds in zip(policies, draws.seeds, strict=True)
                for column in columns
            )
        )


@dataclass(frozen=True, slots=True)
class OfOrdered:
    """A function of one column of one policy: of its numbers ascending (m,), how many numbers of each resample are
    each of these or before (m, R), and how many a resample has.
    """

    of: Callable[[np.ndarray, np.ndarray, int], np.ndarray]

    def __call__(self, policies: Sequence[Columns], draws: Draws) -> np.ndarray:
        ((column,),), (seeds,) = policies, draws.seeds
        order = np.argsort(column, axis=None)
        seed, start = np.unravel_index(order, column.shape)
        size = int(draws.starts[:, 0].sum(dtype=int) * seeds[:, 0].sum(dtype=int))
        kind = np.uint16 if size < 2**16 else np.uint32
        reached = np.empty((column.size, draws.number), kind)
        np.multiply(draws.starts[start], seeds[seed], out=reached, casting="unsafe")
        for before, here in pairwise(
            reached
        ):  # rows of many resamples each: faster than `np.cumsum` along them
            here += before
        return self.of(column.ravel()[order], reached, size)


def once(starts: int, seeds: Sequence[int]) -> Draws:
    """One resample that has each start and each seed once."""
    return Draws(np.ones((starts, 1), np.uint16), tuple(np.ones((count, 1), np.uint16) for count in seeds))


def each_left_out(starts: int, seeds: Sequence[int]) -> Iterator[Draws]:
    """The n resamples that lack each start in turn, in parts."""
    width = _width(starts, seeds)
    for first in range(0, starts, width):
        number = min(width, starts - first)
        counts = np.ones((starts, number), np.uint16)
        counts[first + np.arange(number), np.arange(number)] = 0
        yield Draws(counts, once(starts, seeds).seeds)


@lru_cache(maxsize=2)
def of_starts(starts: int, seeds: tuple[int, ...], resamples: int) -> Draws:
    """Resamples of so many starts with every seed: the draws of `scipy.stats.bootstrap` with the seed 0."""
    return _drawn(np.random.default_rng(0), starts, seeds, resamples, with_starts=True, over=())


@lru_cache(maxsize=4)
def of_starts_and_seeds(
    starts: int, seeds: tuple[int, ...], resamples: int, of_parts: int
) -> tuple[Draws, Draws, dict[int, Draws]]:
    """Resamples of starts and of the seeds of each policy that has several, drawn independently.

    Of S seeds S - 1 are drawn. Also `of_parts` resamples of starts alone, and of the seeds of each such policy alone.
    """
    rng = np.random.default_rng(0)
    several = [policy for policy, count in enumerate(seeds) if count > 1]
    both = _drawn(rng, starts, seeds, resamples, with_starts=True, over=several)
    alone = _drawn(rng, starts, seeds, of_parts, with_starts=True, over=())
    of_seeds = [_drawn(rng, starts, seeds, of_parts, with_starts=False, over=(one,)) for one in several]
    return both, alone, dict(zip(several, of_seeds, strict=True))


def _drawn(
    rng: np.random.Generator,
    starts: int,
    seeds: Sequence[int],
    resamples: int,
    *,
    with_starts: bool,
    over: Sequence[int],
) -> Draws:
    """Resamples of the starts, and of the seeds of the policies `over`; each once of what is not drawn."""
    usual, width = once(starts, seeds), _width(starts, seeds)
    found: dict[int, list[np.ndarray]] = {}
    for first in range(0, resamples, width):
        number = min(width, resamples - first)
        if with_starts:
            found.setdefault(-1, []).append(_counted(rng, number, starts, starts))
        for policy in over:
            found.setdefault(policy, []).append(_counted(rng, number, seeds[policy], seeds[policy] - 1))
    counts = {part: np.concatenate(blocks, axis=1) for part, blocks in found.items()}
    of_seeds = (counts.get(policy, every) for policy, every in enumerate(usual.seeds))
    return Draws(counts.get(-1, usual.starts), tuple(of_seeds))


def _width(starts: int, seeds: Sequence[int]) -> int:
    """Resamples that are computed at once."""
    return max(1, NUMBERS_AT_ONCE // (starts * max(seeds)))


def _counted(rng: np.random.Generator, resamples: int, of: int, drawn: int) -> np.ndarray:
    """How often each of `of` is among `drawn` in each resample, uint16 (of, resamples)."""
    places = rng.integers(0, of, (resamples, drawn))
    places += of * np.arange(resamples)[:, None]
    counts = np.bincount(places.ravel(), minlength=resamples * of)
    return counts.reshape(resamples, of).T.astype(np.uint16, order="C")


def _mean(column: np.ndarray, starts: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Of a column (S, n), of each resample (R,)."""
    total = (seeds * (column @ starts)).sum(axis=0)
    return total / (starts[:, 0].sum() * seeds[:, 0].sum(dtype=int))


def middle(ordered: np.ndarray, reached: np.ndarray, size: int) -> np.ndarray:
    """The median, as `OfOrdered` takes it."""
    ends = (_at(ordered, reached, place) for place in {(size - 1) // 2, size // 2})
    return np.mean([*ends], axis=0)


def trimmed(ordered: np.ndarray, reached: np.ndarray, size: int) -> np.ndarray:
    """The mean without the lowest and the highest quarter, each rounded down, as `OfOrdered` takes it."""
    cut = int(0.25 * size)
    above = (size - cut) - np.clip(
        reached[:-1], cut, size - cut
    )  # how many of the middle are beyond each number
    return (ordered[0] * (size - 2 * cut) + np.diff(ordered) @ above.astype(float)) / (size - 2 * cut)


def _at(ordered: np.ndarray, reached: np.ndarray, place: int) -> np.ndarray:
    """The number at a place of each resample, counted from 0: the first that more than `place` numbers reach."""
    resample = np.arange(reached.shape[1])
    low, high = np.zeros(resample.size, int), np.full(resample.size, len(ordered) - 1)
    for _ in range(len(ordered).bit_length()):
        halfway = (low + high) // 2
        is_before = reached[halfway, resample] <= place
        low, high = np.where(is_before, halfway + 1, low), np.where(is_before, high, halfway)
    return ordered[low]
