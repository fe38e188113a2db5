"""Affine normalisation of vectors, kept as buffers so that it travels inside every checkpoint."""

import torch
from torch import Tensor, nn


class Normaliser(nn.Module):
    """y = (x - offset) / scale over the last axis (D,); one made without statistics refuses to work.

    `fit` centres the range [low, high] on 0 and stretches it to [-1, 1]; ranges under `min_range` are stretched as if
    they were that wide, so that a channel that hardly moves is not blown up into noise.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.offset: Tensor
        self.scale: Tensor
        self.register_buffer("offset", torch.full((size,), torch.nan))
        self.register_buffer("scale", torch.full((size,), torch.nan))

    def fit(self, low: Tensor, high: Tensor, min_range: float = 1e-2) -> None:
        """Sets the statistics from the lowest and highest values (D,)."""
        self.offset.copy_((low + high) / 2)
        self.scale.copy_(((high - low) / 2).clamp(min=min_range / 2))

    def normalise(self, x: Tensor) -> Tensor:
        return (x - self.offset) / self.scale

    def denormalise(self, y: Tensor) -> Tensor:
        return y * self.scale + self.offset
