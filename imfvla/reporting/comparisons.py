"""Two rows compared in pairs, as Table 3 does: what it comes to, or why the pairing is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from imfvla.reporting.mapping import Comparison
from imfvla.reporting.measured import Measured
from imfvla.reporting.results import Result, latencies, returns, successes

COLUMNS = {
    "avg_return": returns,
    "success_episodes": successes,
    "inference_ms_mean": latencies,
    "inference_fps": latencies,
}


@dataclass(frozen=True, slots=True)
class Compared:
    """A row of Table 3. `result` is None where a row is missing or `refused` says why it cannot be had."""

    comparison: Comparison
    row: Result
    baseline: Result
    result: Measured | None = None
    p: float | None = None
    p_holm: float | None = None
    refused: str | None = None

    @property
    def is_missing(self) -> bool:
        return self.row.is_missing or self.baseline.is_missing


def compare(comparisons: Sequence[Comparison], results: Sequence[Result]) -> list[Compared]:
    """Each comparison on our rows, p-values corrected over all of them."""
    named = {result.name: result for result in results}
    return [_compare(c, named[c.row.name], named[c.baseline.name]) for c in comparisons]


def _compare(comparison: Comparison, row: Result, baseline: Result) -> Compared:
    compared = Compared(comparison, row, baseline)
    if compared.is_missing:
        return compared
    refused = None
    if len(row.evaluated) != len(baseline.evaluated):
        refused = f"{row.name} has {len(row.evaluated)} training seeds and {baseline.name} {len(baseline.evaluated)}"
    if refused:
        return replace(compared, refused=refused)
    column = COLUMNS[comparison.of]
    ours, theirs = column(row.episodes).astype(float), column(baseline.episodes).astype(float)
    is_inverse = (comparison.operation == "inverse_ratio") != (comparison.of == "inference_fps")

    def statistic(a, b, axis=-1):
        if comparison.operation == "difference":
            return a.sum(axis=axis) - b.sum(axis=axis)
        a, b = a.mean(axis=axis), b.mean(axis=axis)
        return b / a if is_inverse else a / b

    interval = stats.bootstrap(
        (ours, theirs), statistic, paired=True, rng=np.random.default_rng(0)
    ).confidence_interval
    return replace(
        compared, result=Measured(float(statistic(ours, theirs)), float(interval.low), float(interval.high))
    )
