"""A generator that predicts the clean chunk at any noise level and samples by noising its prediction less and less.

Shapes: B batch, H steps, A action. t = 0 is data, t = 1 is noise.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.generators.base import masked_error, refuse_nfe
from imfvla.options import above


class Denoiser:
    """Learns the mean of the clean chunk given the noisy one. clip: bound of normalised actions."""

    core_interface = "flow"

    def __init__(self, *, clip: Annotated[float, above(0)]) -> None:
        self.clip = clip

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of each chunk (B,) at uniform times."""
        t = torch.rand(len(actions), generator=rng, device=rng.device)
        noise = torch.randn(actions.shape, generator=rng, device=rng.device)
        found = core(_noised(actions, noise, t), t, torch.zeros_like(t), context)
        error = masked_error(found - actions, valid)
        return error, {"squared_error": error.detach().mean()}

    def check_nfe(self, nfe: int) -> None:
        """Any number of steps."""
        if nfe < 1:
            raise refuse_nfe("at least 1", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A): predicted `nfe` times, each time from the last prediction under the same noise."""
        self.check_nfe(nfe)
        chunk = torch.zeros_like(noise)
        for number in range(nfe):
            t = noise.new_full((len(noise),), 1 - number / nfe)
            chunk = core(_noised(chunk, noise, t), t, torch.zeros_like(t), context)
        return chunk.clamp(-self.clip, self.clip)


def _noised(chunk: Tensor, noise: Tensor, t: Tensor) -> Tensor:
    share = t[:, None, None]
    return (1 - share) * chunk + share * noise
