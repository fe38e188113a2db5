"""Episodes of two policies from the same starts, or why they cannot be paired."""

from collections.abc import Callable, Sequence

import numpy as np

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.records import Row

SAME = ("task", "variant", "noise_seed", "max_steps")  # of two protocols whose episodes are pairs
SAME_FOR_TIMES = ("threads", "workers")  # of two fingerprints, besides the machine


class Pairs:
    """Episodes of two policies from the same starts, each with an evaluation for each of its training seeds.

    `refusal` must have been None, with `times` where times are compared.
    """

    def __init__(self, ours: Sequence[Evaluated], theirs: Sequence[Evaluated]) -> None:
        self._ours, self._theirs = ours, theirs

    def columns(self, of: Callable[[Row], float]) -> tuple[np.ndarray, np.ndarray]:
        """A number of each episode: ours (S, n) and theirs (T, n)."""
        return tuple(
            np.array([[of(row) for row in found.episodes] for found in policy], float)
            for policy in (self._ours, self._theirs)
        )

    def policies(
        self, ours: tuple[np.ndarray, ...], theirs: tuple[np.ndarray, ...]
    ) -> tuple[tuple[np.ndarray, ...], ...]:
        """The columns as `bootstrap` takes them: of two policies, or of one where both have the same weights."""
        weights = [
            [found.evaluation.summary["protocol"].get("weights") for found in policy]
            for policy in (self._ours, self._theirs)
        ]
        return ((*ours, *theirs),) if weights[0] == weights[1] else (ours, theirs)


def refusal(ours: Sequence[Evaluated], theirs: Sequence[Evaluated], *, times: bool = False) -> str | None:
    """Why two policies' episodes cannot be paired, as a clause; None if they can.

    All evaluations must have met the same starts, by number and digest, with the same noise seed; with `times`, on
    machines with the same fingerprint, with as many threads and workers.
    """
    first, *others = [*ours, *theirs]
    for other in others:
        reason = _differing(first, other) or (_differing_machines(first, other) if times else None)
        if reason:
            return reason
    return None


def _differing(one: Evaluated, other: Evaluated) -> str | None:
    names = _names(one, other)
    ours, theirs = one.evaluation.summary["protocol"], other.evaluation.summary["protocol"]
    for key in SAME:
        if ours.get(key) != theirs.get(key):
            return f"{key} is {ours.get(key)!r} of {names[0]} and {theirs.get(key)!r} of {names[1]}"
    if len(one.episodes) != len(other.episodes):
        return f"{names[0]} has {len(one.episodes)} episodes and {names[1]} {len(other.episodes)}"
    for row, their_row in zip(one.episodes, other.episodes, strict=True):
        if row["start_digest"] != their_row["start_digest"]:
            return (
                f"seed {row['seed']} of {names[0]} starts from {row['start_digest']} and seed {their_row['seed']} of "
                f"{names[1]} from {their_row['start_digest']}"
            )
    return None


def _differing_machines(one: Evaluated, other: Evaluated) -> str | None:
    names = _names(one, other)
    facts = []
    for found in (one, other):
        fingerprint, protocol = found.evaluation.summary["fingerprint"], found.evaluation.summary["protocol"]
        more = {key: fingerprint.get(key) for key in SAME_FOR_TIMES}
        facts.append(fingerprint["machine"] | more | {"device": protocol.get("device")})
    ours, theirs = facts
    differing = [key for key in (ours | theirs) if ours.get(key) != theirs.get(key)]
    if not differing:
        return None
    values = ", ".join(f"{key} {ours.get(key)!r} and {theirs.get(key)!r}" for key in differing)
    return f"{names[0]} and {names[1]} were timed on different machines: {values}"


def _names(*evaluated: Evaluated) -> list[str]:
    return [str(found.evaluation.folder) for found in evaluated]
