"""Gradient clipping by the gradients' own scale, one rule for every method.

A fixed norm means something else for every loss: at 1.0 iMF was clipped in every interval of its metrics, DDPM and L1
in none (docs/results.md, "What clipping did"). To AdamW the size of a loss does not matter; so it should not here.
"""

import math

MEMORY = 0.98  # of the running mean, some 50 steps


class Clipping:
    """The norm at which the next gradient is clipped: `factor` times the running mean of clipped norms, and `norm`.

    Either may be None, for no such limit. `scale` is the running mean, None before the first step, and all that a
    resumed run needs.
    """

    def __init__(self, factor: float | None, norm: float | None, scale: float | None = None) -> None:
        self.factor, self.norm, self.scale = factor, norm, scale

    @property
    def limit(self) -> float:
        """Infinite where nothing limits the next gradient, as at the first step of a relative rule."""
        relative = math.inf if self.factor is None or self.scale is None else self.factor * self.scale
        return relative if self.norm is None else min(relative, self.norm)

    def update(self, norm: float) -> bool:
        """Takes in the norm of a gradient before it was clipped; whether it was."""
        kept = min(norm, self.limit)
        self.scale = kept if self.scale is None else MEMORY * self.scale + (1 - MEMORY) * kept
        return kept < norm
