"""The noise that the chunks of an episode start from, over its replannings, and the choice among several samples.

Shapes: N candidates, Tp predicted steps, A action.
"""

import numpy as np
import torch
from torch import Tensor

from imfvla.config.protocol import HELD, ROLLED, ZERO
from imfvla.policy.noise import chunk_noise


class ReplanningNoise:
    """Noise (N, Tp, A) for each replanning of an episode, a function of seeds and numbers alone.

    kind: "fresh" draws it for every replanning; "held" keeps that of the first one for the episode; "rolled" keeps that
      of the steps which the last chunk covered too, and draws the rest; "zero" has none.
    candidates: samples of one replanning; the first has the noise that it would have alone.
    """

    def __init__(
        self, shape: tuple[int, int], noise_seed: int, *, kind: str, scale: float, candidates: int
    ) -> None:
        self._shape, self._noise_seed = shape, noise_seed
        self._kind, self._scale, self._candidates = kind, scale, candidates

    def reset(self, seed: int) -> None:
        """Forgets the last episode."""
        self._seed = seed
        self._last: Tensor | None = None

    def draw(self, number: int, advance: int) -> Tensor:
        """For replanning `number`, which is `advance` steps after the one before."""
        if self._kind == ZERO:
            return torch.zeros(self._candidates, *self._shape)
        place = (self._noise_seed, self._seed, 0 if self._kind == HELD else number)
        places = [place, *((*place, candidate) for candidate in range(1, self._candidates))]
        drawn = self._scale * chunk_noise(self._shape, places)
        if self._kind == ROLLED and self._last is not None and advance < self._shape[0]:
            drawn = torch.cat((self._last[:, advance:], drawn[:, self._shape[0] - advance :]), dim=1)
        self._last = drawn
        return drawn


def distances(
    chunks: np.ndarray, last: np.ndarray, advance: int, scale: np.ndarray, first: int = 0
) -> np.ndarray:
    """Root-mean-square distance (N,) of chunks (N, Tp, A) from the last one (Tp, A) over the steps that both cover.

    In shares of `scale` (A,); `advance` is the number of steps from the last decision to this one; entries of the new
    chunks before `first` do not count. Not a number where no step is covered by both.
    """
    shared = len(last) - advance
    if shared <= first:
        return np.full(len(chunks), np.nan)
    error = (chunks[:, first:shared] - last[advance + first :]) / scale
    return np.sqrt(np.square(error, dtype=np.float64).mean(axis=(1, 2)))
