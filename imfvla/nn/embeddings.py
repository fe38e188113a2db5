"""Embeddings of flow times."""

import math

import torch
from torch import Tensor, nn

from imfvla.nn.dual import Same, SiLU, elementwise, linear_map
from imfvla.nn.linear import Linear


class TimeEmbedding(nn.Module):
    """A scalar in [0, 1] as a vector: sinusoids of 0.1 ... `max_rad` rad, then a two-layer MLP.

    Low frequencies matter: the derivative with respect to t enters the Mean Flow target, so that the frequencies of
    image diffusion (t x 1000) make training diverge. Shapes: (B,) -> (B, width).
    """

    def __init__(self, width: int, max_rad: float, num_frequencies: int = 32) -> None:
        super().__init__()
        self.frequencies: Tensor
        frequencies = torch.exp(torch.linspace(math.log(0.1), math.log(max_rad), num_frequencies))
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.mlp = nn.Sequential(Linear(2 * num_frequencies, width), SiLU(), Linear(width, width))

    def forward(self, time: Same) -> Same:
        angles = linear_map(lambda time: time.unsqueeze(-1) * self.frequencies, time)
        sin = elementwise(torch.sin, torch.cos, angles)
        cos = elementwise(torch.cos, lambda angles: -angles.sin(), angles)
        return self.mlp(linear_map(lambda *parts: torch.cat(parts, dim=-1), sin, cos))
