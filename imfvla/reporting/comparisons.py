"""Two rows compared in pairs, as in Table 3: the result, or why the pairing is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imfvla.reporting.mapping.comparisons import Comparison
from imfvla.reporting.results import Result
from imfvla.reporting.statistics.contrasts import (
    return_difference,
    return_ranks,
    return_ratio,
    speedup,
    success_difference,
    success_ratio,
)
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.statistics.pairs import Pairs, refusal
from imfvla.reporting.statistics.significance import holm

TIMES = ("inference_ms_mean", "inference_fps")
CONTRASTS = {  # metric and operation -> function, and whether it takes row and baseline the other way round
    ("avg_return", "ratio"): (return_ratio, False),
    ("avg_return", "inverse_ratio"): (return_ratio, True),
    ("avg_return", "difference"): (return_difference, False),
    ("success_episodes", "ratio"): (success_ratio, False),
    ("success_episodes", "inverse_ratio"): (success_ratio, True),
    ("success_episodes", "difference"): (success_difference, False),
    ("inference_ms_mean", "ratio"): (speedup, True),
    ("inference_ms_mean", "inverse_ratio"): (speedup, False),
    ("inference_fps", "ratio"): (speedup, False),
    ("inference_fps", "inverse_ratio"): (speedup, True),
}


@dataclass(frozen=True, slots=True)
class Compared:
    """A row of Table 3. `result` is None where a row is missing, or where `refused` says why there is none.

    `detectable` is the smallest result in favour of the row that so many pairs would have shown (see `Contrast`).
    `p_ranks` and `p_ranks_holm` are of returns by `return_ranks`, the latter with the other comparisons' own tests.
    """

    comparison: Comparison
    row: Result
    baseline: Result
    result: Measured | None = None
    p: float | None = None
    p_holm: float | None = None
    test: str | None = None
    p_ranks: float | None = None
    p_ranks_holm: float | None = None
    detectable: float | None = None
    refused: str | None = None

    @property
    def is_missing(self) -> bool:
        return self.row.is_missing or self.baseline.is_missing


def compare(comparisons: Sequence[Comparison], results: Sequence[Result]) -> list[Compared]:
    """Each comparison on our rows, p-values corrected over all of them."""
    named = {result.name: result for result in results}
    compared = [_compare(c, named[c.row.name], named[c.baseline.name]) for c in comparisons]
    corrected = holm([found.p for found in compared])
    by_ranks = holm([found.p if found.p_ranks is None else found.p_ranks for found in compared])
    return [
        replace(found, p_holm=p, p_ranks_holm=None if found.p_ranks is None else p_ranks)
        for found, p, p_ranks in zip(compared, corrected, by_ranks, strict=True)
    ]


def _compare(comparison: Comparison, row: Result, baseline: Result) -> Compared:
    compared = Compared(comparison, row, baseline)
    if compared.is_missing:
        return compared
    if (comparison.of, comparison.operation) not in CONTRASTS:
        reason = f"{comparison.operation} of {comparison.of} is not offered: use a ratio"
        return replace(compared, refused=reason)
    reason = refusal(row.evaluated, baseline.evaluated, times=comparison.of in TIMES)
    if reason:
        return replace(compared, refused=reason)
    contrast, is_turned = CONTRASTS[comparison.of, comparison.operation]
    policies = (row.evaluated, baseline.evaluated)
    pairs = Pairs(*(reversed(policies) if is_turned else policies))
    found = contrast(pairs)
    result, detectable = found.result, found.detectable
    if contrast is success_difference:  # of episodes, as the paper prints it
        starts = len(row.evaluated[0].episodes)
        result, detectable = result.scaled(starts), None if detectable is None else starts * detectable
    elif is_turned and detectable is not None:
        detectable = 1 / detectable
    p_ranks = return_ranks(pairs) if comparison.of == "avg_return" else None
    return replace(
        compared, result=result, p=found.p, test=found.test, p_ranks=p_ranks, detectable=detectable
    )
