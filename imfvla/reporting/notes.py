"""The notes below the tables about their uncertainty."""

from collections.abc import Sequence

from imfvla.reporting.cells import BY_NAME
from imfvla.reporting.comparisons import Compared
from imfvla.reporting.mapping import settings
from imfvla.reporting.mapping.comparisons import Comparison
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.statistics.power import ALPHA, POWER, detectable_share_difference

VERSUS = " vs "  # between the two rows of a comparison, in the paper's words too


def detectable_success(pairs: int) -> str:
    """The smallest difference of successes that so many episodes of two policies show."""
    share = detectable_share_difference(pairs)
    if share is None:
        return f"{pairs} pairs of episodes show no difference of two policies' successes at p = {ALPHA}, however large."
    return (
        f"Smallest detectable difference: {pairs} pairs of episodes show one of {100 * share:.0f} percentage points "
        f"between two policies' successes with probability {POWER} at p = {ALPHA} (exact McNemar) where both "
        "disagree on half of the starts, and smaller ones where they disagree on fewer."
    )


def pairing(compared: Sequence[Compared]) -> tuple[str, ...]:
    """How measured comparisons were made, and the smallest result that they would have shown."""
    tests = ", ".join(dict.fromkeys(found.test for found in compared))
    each = "; ".join(f"{label(found.comparison)} {_detectable(found)}" for found in compared)
    return (
        "Ours: pairs of episodes from the same starts with the same noise seed. In brackets: 95% intervals, of "
        "differences of counts Newcombe's, else BCa bootstrap over pairs; with several training seeds bootstrap over "
        f"these too. p: two-sided ({tests}); Holm over {sum(found.p is not None for found in compared)} comparisons.",
        f"Smallest detectable results in favour of the row, with probability {POWER} at p = {ALPHA}, each comparison "
        f"by itself: {each}.",
    )


def names(comparison: Comparison) -> tuple[str, str]:
    """What is compared and by what: the paper's words, or ours of both rows and the title of the column."""
    if comparison.paper:
        return comparison.paper.comparison, comparison.paper.metric
    row, baseline = comparison.row, comparison.baseline
    common = set(_parts(row)) & set(_parts(baseline))
    # what both rows have is not said, but how often they call the network is
    common = {part for part in common if not part.startswith("infer")}
    return f"{_short(row, common)}{VERSUS}{_short(baseline, common)}", BY_NAME[comparison.of].title


def label(comparison: Comparison) -> str:
    """Both of `names`."""
    return ", ".join(names(comparison))


def _short(row: TableRow, common: set[str]) -> str:
    own = [part for part in _parts(row) if part not in common]
    return f"{row.method} ({', '.join(own)})" if own else row.method


def _parts(row: TableRow) -> list[str]:
    """What the row says of its setting, and how its world differs."""
    return [*row.setting.split(", "), *([settings.label(row.changes)] if row.changes else [])]


def _detectable(found: Compared) -> str:
    if found.detectable is None:
        return "none"
    is_difference = found.comparison.operation == "difference"
    return f"{found.detectable:+.1f}" if is_difference else f"{found.detectable:.2f}×"
