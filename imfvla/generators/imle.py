"""Implicit maximum likelihood: of several samples the one nearest to the data is pulled to it (IMLE Policy).

The network maps noise to a chunk in one call. For each observation it draws `candidates` chunks; those that are nearer
to the demonstrated one than `rejection` are left alone, and the nearest of the others learns to be that chunk
(rejection-sampling IMLE, arXiv 2502.12371 for policies). Every demonstration has a sample that learns it, so no way of
doing the task is dropped or averaged with another. Nothing keeps a sample from lying between them: that a candidate is
never the nearest is all that speaks against it. arXiv 2603.09415 trains such a network on the samples of a flow in
place of the demonstrations; here it learns from the demonstrations, as all others do.

Shapes: B batch, M candidates of each observation, H steps, A action.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.generators.base import masked_error, refuse_nfe
from imfvla.options import above, at_least


class ImplicitMaximumLikelihood:
    """Learns and samples in one call. The core is given noise at t = 1, r = 0.

    candidates: samples of each observation among which the nearest is looked for; the source takes 20.
    rejection: root-mean-square distance, in deviations, below which a sample is near enough and does not learn.
    clip: normalised actions lie within [-clip, clip]; the sample is clamped there.
    """

    core_interface = "flow"

    def __init__(
        self,
        *,
        candidates: Annotated[int, at_least(1)],
        rejection: Annotated[float, at_least(0)],
        clip: Annotated[float, above(0)],
    ) -> None:
        self.candidates, self.rejection, self.clip = candidates, rejection, clip

    def chunk(self, core: nn.Module, context: Any, noise: Tensor) -> Tensor:
        """The chunk that belongs to noise (B, H, A): (B, H, A)."""
        t = noise.new_ones(len(noise))
        return core(noise, t, torch.zeros_like(t), context)

    def distances(self, chunks: Tensor, actions: Tensor, valid: Tensor) -> Tensor:
        """Root-mean-square distance of candidates (B * M, H, A) from actions (B, H, A): (B, M)."""
        x = actions.repeat_interleave(self.candidates, dim=0)
        error = masked_error(chunks - x, valid.repeat_interleave(self.candidates, dim=0))
        return error.sqrt().unflatten(0, (len(actions), self.candidates))

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Distance of the nearest candidate that is not rejected, for each chunk (B,); 0 where all of them are.

        Candidates are drawn without gradient, and the chosen ones computed once more with it.
        """
        batch = len(actions)
        shape = (batch * self.candidates, *actions.shape[1:])
        noise = draw(torch.randn, shape, rng=rng).to(actions)
        with torch.no_grad():
            chunks = self.chunk(core, context.repeat(self.candidates).detach(noise.dtype), noise)
            distance = self.distances(chunks, actions, valid)
        near = distance < self.rejection
        nearest = distance.masked_fill(near, torch.inf).argmin(dim=1)
        rows = torch.arange(batch, device=noise.device) * self.candidates + nearest
        error = masked_error(self.chunk(core, context, noise[rows]) - actions, valid)
        # The distance, not its square, as in the source; its root has no gradient at zero.
        loss = (error + 1e-12).sqrt() * ~near.all(dim=1)
        return loss, {
            "nearest_distance": distance.min(dim=1).values.mean(),
            "mean_distance": distance.mean(),
            "rejected": near.float().mean(),
        }

    def check_nfe(self, nfe: int) -> None:
        """There is one evaluation."""
        if nfe != 1:
            raise refuse_nfe("1 with generator=imle (noise to chunk in one call)", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """The chunk (B, H, A) of this noise."""
        self.check_nfe(nfe)
        return self.chunk(core, context, noise).clamp(-self.clip, self.clip)
