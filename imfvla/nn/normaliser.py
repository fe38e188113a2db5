"""Affine normalisation, kept as buffers so that it travels inside every checkpoint."""

import torch
from torch import Tensor, nn


class Normaliser(nn.Module):
    """y = (x - offset) / scale over the last axes `shape`; one that was never fitted gives not-a-number."""

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self.offset: Tensor
        self.scale: Tensor
        self.register_buffer("offset", torch.full(shape, torch.nan))
        self.register_buffer("scale", torch.full(shape, torch.nan))

    def fit(self, offset: Tensor, scale: Tensor, min_scale: float) -> None:
        """Sets both; scales under `min_scale` are raised to it, so that a still channel is not blown up into noise."""
        self.offset.copy_(offset)
        self.scale.copy_(scale.clamp(min=min_scale))

    def normalise(self, x: Tensor) -> Tensor:
        return (x - self.offset) / self.scale

    def denormalise(self, y: Tensor) -> Tensor:
        return y * self.scale + self.offset
