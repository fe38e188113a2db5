"""An exponential average of the weights, which is what gets evaluated."""

import copy

import torch
from torch import nn


def decay_at(step: int, limit: float) -> float:
    """Decay of the average at update `step` (0-based): rises with the weights seen so far, up to `limit`."""
    return min(limit, (1 + step) / (10 + step))


class Ema:
    """Holds `policy`, a copy whose parameters follow `source` as e <- d e + (1 - d) w. Buffers are copied."""

    def __init__(self, source: nn.Module, limit: float) -> None:
        self.limit = limit
        self.policy = copy.deepcopy(source).requires_grad_(False).eval()
        self._averaged = list(self.policy.parameters())
        self._source = list(source.parameters())
        self._buffers = list(zip(self.policy.buffers(), source.buffers(), strict=True))

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Takes the weights after update `step` (0-based) in."""
        torch._foreach_lerp_(self._averaged, self._source, 1 - decay_at(step, self.limit))
        for averaged, current in self._buffers:
            averaged.copy_(current)
