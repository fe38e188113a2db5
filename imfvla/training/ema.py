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
        self._source = source

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Averages in the weights after update `step` (0-based)."""
        averages, currents = list(self.policy.parameters()), list(self._source.parameters())
        torch._foreach_lerp_(averages, currents, 1 - decay_at(step, self.limit))
        for averaged, current in zip(self.policy.buffers(), self._source.buffers(), strict=True):
            averaged.copy_(current)
