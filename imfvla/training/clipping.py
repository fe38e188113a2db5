"""Gradient clipping by the gradients' own scale, one rule for every method.

A fixed norm means something else for every loss: at 1.0 iMF was clipped in every interval of its metrics, DDPM and L1
in none (docs/first_campaign.md, "What clipping did"). To AdamW the size of a loss does not matter; so it should not
here.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from imfvla.training.sharding import own_part

MEMORY = 0.98  # of the running mean, some 50 steps
TINY = 1e-6  # as `torch.nn.utils.clip_grad_norm_` adds it to a norm


class Clipping:
    """The norm at which the next gradient is clipped: `factor` times the running mean of clipped norms, and `norm`.

    Either may be None, for no such limit. `scale`, a scalar, is the running mean, infinite before the first step, and
    all that a resumed run needs. It stays on the gradients' device, and nothing here is read from there.
    """

    def __init__(
        self,
        factor: float | None,
        norm: float | None,
        scale: float | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.factor, self.norm = factor, norm
        self.scale = torch.full((), math.inf if scale is None else scale, dtype=torch.float64, device=device)

    @property
    def limit(self) -> Tensor:
        """Infinite where nothing limits the next gradient, as at the first step of a relative rule."""
        relative = torch.full_like(self.scale, math.inf) if self.factor is None else self.factor * self.scale
        return relative if self.norm is None else relative.clamp(max=self.norm)

    def clip(self, gradients: Sequence[Tensor], norm: Tensor, counts: Tensor) -> Tensor:
        """Scales gradients whose common norm is `norm` down to the limit, in place; whether they exceeded it.

        The norm goes into the scale where `counts`, a boolean scalar.
        """
        limit = self.limit
        shrink = ((norm + TINY).reciprocal() * limit.to(norm.dtype)).clamp(max=1.0)
        torch._foreach_mul_([own_part(gradient) for gradient in gradients], shrink)
        exact = norm.to(torch.float64)
        kept = torch.minimum(exact, limit)
        mean = torch.where(self.scale.isinf(), kept, MEMORY * self.scale + (1 - MEMORY) * kept)
        self.scale = torch.where(counts, mean, self.scale)
        return kept < exact

    def state(self) -> float | None:
        """The scale as a number, None before the first step."""
        scale = self.scale.item()
        return None if math.isinf(scale) else scale
