"""Regression: one evaluation, no noise, the L1 or L2 error. What a generator must beat where demonstrations have modes.

Shapes: B batch, H steps, A action.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.generators.base import masked_mean, refuse_nfe
from imfvla.options import above, one_of


class Regression:
    """Learns the median of the action given the observation, or its mean. The core is given zeros at t = 1, r = 0.

    power: of the absolute error: 1 has its optimum at the median of each number of the chunk, 2 at its mean.
    clip: normalised actions lie within [-clip, clip]; the prediction is clamped there.
    """

    core_interface = "flow"
    uses_noise = False

    def __init__(self, *, clip: Annotated[float, above(0)], power: Annotated[int, one_of(1, 2)]) -> None:
        self.clip, self.power = clip, power

    def predict(self, core: nn.Module, context: Any, like: Tensor) -> Tensor:
        """The core's answer, of the shape of `like` (B, H, A), which is not read."""
        t = like.new_ones(len(like))
        return core(torch.zeros_like(like), t, torch.zeros_like(t), context)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean error of each chunk (B,), absolute or squared; nothing is drawn from `rng`."""
        error = masked_mean((self.predict(core, context, actions) - actions).abs() ** self.power, valid)
        return error, {"absolute_error" if self.power == 1 else "squared_error": error.detach().mean()}

    def check_nfe(self, nfe: int) -> None:
        """There is one evaluation: nothing moves from noise to data in steps."""
        if nfe != 1:
            raise refuse_nfe(f"1 with generator=l{self.power} (one-step regression)", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """The predicted chunk (B, H, A), whatever the noise."""
        self.check_nfe(nfe)
        return self.predict(core, context, noise).clamp(-self.clip, self.clip)
