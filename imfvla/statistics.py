"""Ranges and moments to which normalisers are fitted."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """What a policy's normalisers need, float32.

    Of states (S,) and clean actions (A,): over all recorded control steps. Of displacements (Tp, A), the actions of a
    chunk less the state channels that they are relative to, as these are at its decision: over all windows, steps past
    an episode's end left out. Those of absolute channels mean nothing.
    """

    state_min: np.ndarray
    state_max: np.ndarray
    state_mean: np.ndarray
    state_std: np.ndarray
    action_min: np.ndarray
    action_max: np.ndarray
    action_mean: np.ndarray
    action_std: np.ndarray
    displacement_mean: np.ndarray
    displacement_std: np.ndarray

    @classmethod
    def of(
        cls, state: np.ndarray, action: np.ndarray, displacement: np.ndarray, valid: np.ndarray
    ) -> "Statistics":
        """Statistics of states (T, S), actions (T, A) and displacements (W, Tp, A), valid (W, Tp)."""
        per_step = (moment for rows in (state, action) for moment in _moments(rows))
        counted = valid[..., None]
        number = np.maximum(counted.sum(axis=0), 1)  # a step that is never valid gets mean and deviation 0
        mean = (displacement * counted).sum(axis=0, dtype=np.float64) / number
        variance = (np.square(displacement - mean) * counted).sum(axis=0) / number
        return cls(*per_step, mean.astype(np.float32), np.sqrt(variance).astype(np.float32))

    def to_json(self) -> dict[str, list]:
        """Lists of numbers by field; `from_json` gives equal arrays back."""
        return {name: values.tolist() for name, values in asdict(self).items()}

    @classmethod
    def from_json(cls, lists: Mapping[str, list]) -> "Statistics":
        """Inverse of `to_json`."""
        return cls(**{name: np.asarray(values, np.float32) for name, values in lists.items()})


def _moments(rows: np.ndarray) -> tuple[np.ndarray, ...]:
    rows = rows.astype(np.float64)
    moments = (rows.min(axis=0), rows.max(axis=0), rows.mean(axis=0), rows.std(axis=0))
    return tuple(moment.astype(np.float32) for moment in moments)
