"""An exponential average of the weights, which is what gets evaluated."""

import copy
from types import MappingProxyType

import torch
from torch import nn

from imfvla.training.spans import WHOLE, Spans


def decay_at(step: int, limit: float) -> float:
    """Decay of the average at update `step` (0-based): rises with the weights seen so far, up to `limit`."""
    return min(limit, (1 + step) / (10 + step))


class Ema:
    """Holds `policy`, a copy whose parameters follow `source` as e <- d e + (1 - d) w. Buffers are copied.

    A parameter that `spans` names is averaged in the steps [first, end) alone, as if the training began there: the
    weights that it begins with do not linger.
    """

    def __init__(self, source: nn.Module, limit: float, spans: Spans = MappingProxyType({})) -> None:
        self.limit = limit
        self.policy = copy.deepcopy(source).requires_grad_(False).eval()
        self._source = source
        self._spans = [spans.get(name, WHOLE) for name, _ in source.named_parameters()]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Averages in the weights after step `step` (0-based), also where they have not changed in it."""
        pairs = list(zip(self.policy.parameters(), self._source.parameters(), self._spans, strict=True))
        for span in set(self._spans):
            first, end = span
            if first <= step < end:
                averages, currents = zip(*((a, c) for a, c, own in pairs if own == span), strict=True)
                torch._foreach_lerp_(averages, currents, 1 - decay_at(step - first, self.limit))
        for averaged, current in zip(self.policy.buffers(), self._source.buffers(), strict=True):
            averaged.copy_(current)

    @torch.no_grad()
    def settle(self, step: int) -> None:
        """Parameters of `source` that no longer learn at `step` take their average, and stay there."""
        for average, current, (_, end) in zip(
            self.policy.parameters(), self._source.parameters(), self._spans, strict=True
        ):
            if step >= end and current.requires_grad:
                current.copy_(average)
                current.requires_grad_(False)
