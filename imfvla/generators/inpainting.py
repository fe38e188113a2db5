"""Real-time chunking at inference: a sampler of several steps completes actions that are already decided.

Guidance by the pseudo-inverse (arXiv 2506.07339 after 2305.04391). The flow's estimate of the clean chunk is moved by

    t w(t) (d estimate / d z)^T W (values - estimate),   w(t) = min(5, ((1 - t)^2 + t^2) / (t (1 - t))),

towards the chunk that the robot is executing, with t = 0 data and t = 1 noise. For independent actions of unit variance
this is the exact conditional mean where the bound does not act; otherwise it is an approximation.

Shapes: B batch, H steps, A action.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

STRONGEST = 5.0  # w(t), which is without bound at both ends, is at most this, as in the source


@dataclass(frozen=True, slots=True)
class Target:
    """Normalised actions that a sample should agree with, and how much it should in each step."""

    values: Tensor  # (B, H, A)
    weights: Tensor  # (H,), 1 where they are decided and 0 where nothing is known


@runtime_checkable
class Inpaints(Protocol):
    """Optional part of a generator that samples in several steps, between which a sample can be corrected."""

    def inpaint(self, core: nn.Module, context: Any, noise: Tensor, nfe: int, target: Target) -> Tensor:
        """As `Generator.sample`, drawn towards `target`; each step takes a derivative too."""
        ...


def soft_weights(steps: int, decided: int, covered: int) -> Tensor:
    """Weights (steps,): 1 for the first `decided`, then falling exponentially to 0 at `covered`, as in the source."""
    falling = (covered - torch.arange(steps)) / (covered - decided + 1)
    falling = falling.clamp(0, 1)
    weights = falling * torch.expm1(falling) / math.expm1(1)
    return torch.where(torch.arange(steps) < decided, 1.0, weights)


def strength(t: float) -> float:
    """w(t): the variance of data of unit variance given z_t, inverted, times t / (1 - t), up to `STRONGEST`."""
    if not 0 < t < 1:
        return STRONGEST
    return min(STRONGEST, ((1 - t) ** 2 + t**2) / (t * (1 - t)))


def pull(
    estimate: Callable[[Tensor], tuple[Tensor, Tensor]], z: Tensor, target: Target
) -> tuple[Tensor, Tensor, Tensor]:
    """What `estimate` says of z (B, H, A), a clean chunk first, and (d clean / d z)^T W (values - clean)."""
    with torch.enable_grad():
        z = z.detach().requires_grad_()
        clean, other = estimate(z)
        error = target.weights[:, None].to(clean) * (target.values - clean.detach())
        # Of a scalar: with the gradient of a tensor, PyTorch's first call takes a second for imports.
        (found,) = torch.autograd.grad((clean * error).sum(), z)
    return clean.detach(), other.detach(), found
