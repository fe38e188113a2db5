"""Temporal ensembling: the action of a step is the mean over all chunks that cover it (arXiv 2304.13705).

Shapes: Tp predicted steps, A action.
"""

import numpy as np


class TemporalEnsemble:
    """Chunks of consecutive control steps, averaged with weights exp(-decay * i), i = 0 for the oldest."""

    def __init__(self, decay: float) -> None:
        self.decay = decay
        self._chunks: list[tuple[int, np.ndarray]] = []  # step of the decision, chunk (Tp, A); oldest first

    def add(self, step: int, chunk: np.ndarray) -> None:
        """Takes the chunk (Tp, A) decided at `step`; forgets those that end before it."""
        self._chunks = [(began, old) for began, old in self._chunks if step < began + len(old)]
        self._chunks.append((step, chunk))

    def action(self, step: int) -> np.ndarray:
        """The action (A,) of `step`, which the latest chunk must cover."""
        said = np.stack([chunk[step - began] for began, chunk in self._chunks])
        weights = np.exp(-self.decay * np.arange(len(said)))
        return (weights / weights.sum()) @ said
