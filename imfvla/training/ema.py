"""An exponential average of the weights, which is what gets evaluated."""

import copy
from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import nn


def decay_at(step: int, limit: float) -> float:
    """Decay of the average at update `step` (0-based): rises with the weights seen so far, up to `limit`."""
    return min(limit, (1 + step) / (10 + step))


class Ema:
    """Holds `policy`, a copy whose parameters follow `source` as e <- d e + (1 - d) w. Buffers are copied.

    A parameter that `first_steps` names is averaged from that step on, as if the training began there: the weights that
    it begins with do not linger.
    """

    def __init__(
        self, source: nn.Module, limit: float, first_steps: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        self.limit = limit
        self.policy = copy.deepcopy(source).requires_grad_(False).eval()
        self._source = source
        self._first_steps = [first_steps.get(name, 0) for name, _ in source.named_parameters()]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Averages in the weights after update `step` (0-based)."""
        pairs = list(zip(self.policy.parameters(), self._source.parameters(), self._first_steps, strict=True))
        for first in set(self._first_steps):
            if step >= first:
                averages, currents = zip(*((a, c) for a, c, start in pairs if start == first), strict=True)
                torch._foreach_lerp_(averages, currents, 1 - decay_at(step - first, self.limit))
        for averaged, current in zip(self.policy.buffers(), self._source.buffers(), strict=True):
            averaged.copy_(current)
