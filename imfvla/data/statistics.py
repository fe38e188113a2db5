"""Ranges and moments of what normalisers are fitted to."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Per dimension, over all recorded control steps: float32 (S,) of states and (A,) of clean actions."""

    state_min: np.ndarray
    state_max: np.ndarray
    state_mean: np.ndarray
    state_std: np.ndarray
    action_min: np.ndarray
    action_max: np.ndarray
    action_mean: np.ndarray
    action_std: np.ndarray

    @classmethod
    def of(cls, state: np.ndarray, action: np.ndarray) -> "Statistics":
        """Statistics of states (T, S) and actions (T, A)."""
        return cls(*(moment for rows in (state, action) for moment in _moments(rows)))

    def to_json(self) -> dict[str, list[float]]:
        """Lists of numbers by field; `from_json` gives equal arrays back."""
        return {name: values.tolist() for name, values in asdict(self).items()}

    @classmethod
    def from_json(cls, lists: Mapping[str, list[float]]) -> "Statistics":
        """Inverse of `to_json`."""
        return cls(**{name: np.asarray(values, np.float32) for name, values in lists.items()})


def _moments(rows: np.ndarray) -> tuple[np.ndarray, ...]:
    rows = rows.astype(np.float64)
    moments = (rows.min(axis=0), rows.max(axis=0), rows.mean(axis=0), rows.std(axis=0))
    return tuple(moment.astype(np.float32) for moment in moments)
