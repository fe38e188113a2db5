"""Action Chunking with Transformers: a conditional variational autoencoder of chunks (arXiv 2304.13705).

In training the style z of a chunk is inferred from the chunk and drawn; the loss is the absolute error of the chunk
decoded from it, plus the divergence of the style from N(0, 1). In a rollout the style is zero, its most likely value.

Shapes: B batch, H steps, A action, Z style width.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.generators.base import masked_mean, refuse_nfe
from imfvla.options import above, at_least


class ActionChunking:
    """Learns chunks and their style; the core is an `imfvla.nn.act.ActCore`.

    kl_weight: weight of the divergence, summed over the style's dimensions. The source takes 10, at which the style
      says nothing here: no optimum has a divergence above (error without a style) / kl_weight, and that error is 0.19.
    clip: normalised actions lie within [-clip, clip]; the prediction is clamped there.
    """

    core_interface = "style"
    uses_noise = False

    def __init__(self, *, kl_weight: Annotated[float, at_least(0)], clip: Annotated[float, above(0)]) -> None:
        self.kl_weight = kl_weight
        self.clip = clip

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,)."""
        mean, log_variance = (part.to(actions) for part in core.style(context, actions, valid))
        noise = draw(torch.randn, mean.shape, rng=rng).to(mean)
        chunk = core(context, mean + (0.5 * log_variance).exp() * noise)
        error = masked_mean((chunk - actions).abs(), valid)
        divergence = divergence_from_standard_normal(mean, log_variance)
        logs = {"absolute_error": error.detach().mean(), "divergence": divergence.detach().mean()}
        return error + self.kl_weight * divergence, logs

    def check_nfe(self, nfe: int) -> None:
        """There is one evaluation."""
        if nfe != 1:
            raise refuse_nfe("1 with generator=act (one decoded chunk)", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """The chunk (B, H, A) of style zero, whatever the noise."""
        self.check_nfe(nfe)
        chunk = core(context, noise.new_zeros(len(noise), core.style_width))
        return chunk.clamp(-self.clip, self.clip)


def divergence_from_standard_normal(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(N(mean, exp(log_variance)) || N(0, 1)), summed over the dimensions: (B, Z) -> (B,).

    It is a small difference of large numbers: in bf16 it comes out negative, so that callers convert before.
    """
    return 0.5 * (mean.square() + log_variance.expm1() - log_variance).sum(-1)
