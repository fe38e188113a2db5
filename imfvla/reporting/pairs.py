"""Two policies compared start by start: with how certain a difference, or why they cannot be paired."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.bootstrap import Bootstrapped, bootstrap
from imfvla.reporting.estimates import log_pooled_mean
from imfvla.reporting.measured import Measured
from imfvla.reporting.metrics import TIMING, Row, wilson_interval
from imfvla.reporting.power import detectable_difference, detectable_share_difference
from imfvla.reporting.significance import mcnemar, sign_flip

SAME = ("task", "variant", "noise_seed", "max_steps")  # of two protocols whose episodes are pairs
SAME_FOR_TIMES = ("threads", "workers")  # of two fingerprints, beside the machine


@dataclass(frozen=True, slots=True)
class Contrast:
    """A difference or a ratio of two policies.

    `p` is two-sided, of `test`, for no difference. `detectable` is the smallest one, in the unit of `result` and in our
    favour, that so many pairs would have shown (see `power`); None where none is.
    """

    result: Measured
    p: float | None
    test: str
    detectable: float | None


class Pairs:
    """Columns of two policies, (S, n) of S training seeds from the same n starts; S may differ between them.

    `refusal` must have been None, for times too where times are compared.
    """

    def __init__(self, ours: Sequence[Evaluated], theirs: Sequence[Evaluated]) -> None:
        self._ours, self._theirs = ours, theirs

    def __len__(self) -> int:
        """Starts."""
        return len(self._ours[0].episodes)

    def columns(self, of: Callable[[Row], float]) -> tuple[np.ndarray, np.ndarray]:
        """A number of each episode, ours and theirs."""
        return _column(self._ours, of), _column(self._theirs, of)


def refusal(ours: Sequence[Evaluated], theirs: Sequence[Evaluated], *, times: bool = False) -> str | None:
    """Why two policies' episodes are no pairs, as a clause without a full stop; None where they are.

    Each policy comes with an evaluation for each training seed. All must have met the same starts, by digest and in
    number, with the same noise seed; with `times`, on the same kind of machine.
    """


def success_difference(pairs: Pairs) -> Contrast:
    """Difference of success shares, with Newcombe's interval and the exact McNemar test."""


def return_difference(pairs: Pairs) -> Contrast:
    """Difference of mean returns, with a BCa interval over pairs and the sign-flip test."""


def return_ratio(pairs: Pairs) -> Contrast:
    """Ratio of mean returns, ours over theirs, with a BCa interval over pairs and the sign-flip test of the difference.

    Not a number where the mean return of theirs is 0, infinite where only an end of the interval lies there.
    """


def latency_ratio(pairs: Pairs) -> Contrast:
    """Ratio of mean times of a chunk, ours over theirs, over pairs; the sign-flip test is of logarithms by episode."""
