"""The noise that a chunk starts from: a function of where it is drawn, so that policies to be compared see the same.

Shapes: N chunks, Tp predicted steps, A action.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor


def chunk_noise(shape: tuple[int, int], places: Iterable[Sequence[int]]) -> Tensor:
    """Standard normal float32 (N, Tp, A) for chunks of `shape` (Tp, A): each from SeedSequence(its place) alone."""
    generators = (np.random.default_rng(np.random.SeedSequence([*map(int, place)])) for place in places)
    drawn = [generator.standard_normal(shape, dtype=np.float32) for generator in generators]
    return torch.from_numpy(np.stack(drawn))
