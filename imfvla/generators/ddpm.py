"""Denoising diffusion, the baseline of Diffusion Policy (arXiv 2006.11239, 2303.04137), and DDIM (arXiv 2010.02502).

Noise levels k = 0 ... K - 1 of the squared-cosine schedule (arXiv 2102.09672), with abar_k the share of the signal's
variance: z_k = sqrt(abar_k) x + sqrt(1 - abar_k) e. The core is given t = (k + 1) / K and r = t.

With K evaluations sampling is ancestral, with the smaller of the two usual variances ("fixed_small"). With fewer it is
DDIM without noise (eta = 0) at trailing levels, which begin at the noisiest one: at the optimum one evaluation then
gives the conditional mean, where leading levels would give back the noise. A trained network's single evaluation does
depend on its noise (docs/results.md, "Samples and averages").

Shapes: B batch, N draws per observation, H steps, A action, K noise levels.
"""

from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.errors import UserError
from imfvla.generators.base import (
    LAST_STEP,
    adapted,
    ancestral_noise,
    masked_error,
    refuse_nfe,
    step_times,
)
from imfvla.generators.inpainting import Target, pull, strength
from imfvla.options import above, at_least

MAX_BETA = 0.999


def squared_cosine(num_levels: int, device: torch.device | None = None) -> Tensor:
    """abar (K,), float64: products of 1 - beta_k, beta_k = min(1 - f(k + 1) / f(k), 0.999), f = squared cosine.

    Computed on `device`: a GPU would be waited for while it is copied there.
    """
    edges = torch.arange(num_levels + 1, dtype=torch.float64, device=device) / num_levels
    kept = torch.cos((edges + 0.008) / 1.008 * torch.pi / 2) ** 2
    return (1 - (1 - kept[1:] / kept[:-1]).clamp(max=MAX_BETA)).cumprod(0)


def trailing_levels(num_levels: int, nfe: int, last_step: float | None = None) -> list[int]:
    """`nfe` noise levels, noisiest first, evenly spaced from K - 1 down (arXiv 2305.08891), or as `step_times` says."""
    if last_step is None:
        return [round(num_levels * (nfe - i) / nfe) - 1 for i in range(nfe)]
    return [max(round(num_levels * t) - 1, 0) for t in step_times(nfe, last_step).tolist()[:-1]]


class DenoisingDiffusion:
    """Learns to tell noise from data at `num_levels` noise levels.

    prediction: what the network outputs: the noise "epsilon", the clean action ("sample"), or
      "v" = sqrt(abar) e - sqrt(1 - abar) x (arXiv 2202.00512). The loss is its mean squared error.
    clip_sample: whether the clean action that each step estimates is clamped to [-clip, clip].
    draws: noise draws per observation; the observation is encoded once for all of them.
    clip: normalised actions lie within [-clip, clip]; the final sample is clamped there.
    last_step: of DDIM, the share of the levels below which the last of several steps is taken, see `step_times`.
    adaptive_power, adaptive_offset: see `adapted`; the source's loss has power 0.
    """

    core_interface = "flow"

    def __init__(
        self,
        *,
        num_levels: int,
        prediction: Literal["epsilon", "sample", "v"],
        clip_sample: bool,
        draws: int,
        clip: Annotated[float, above(0)],
        last_step: Annotated[float, LAST_STEP] | None = None,
        adaptive_power: Annotated[float, at_least(0)] = 0.0,
        adaptive_offset: Annotated[float, above(0)] = 1e-3,
    ) -> None:
        if prediction not in ("epsilon", "sample", "v"):
            raise UserError(f"generator.prediction must be epsilon, sample or v, found {prediction!r}.")
        if num_levels < 1:
            raise UserError(f"generator.num_levels must be at least 1, found {num_levels}.")
        if draws < 1:
            raise UserError(f"generator.draws must be at least 1, found {draws}.")
        self.prediction = prediction
        self.clip_sample, self.clip = clip_sample, clip
        self.draws, self.last_step = draws, last_step
        self.num_levels = num_levels
        self.adaptive_power, self.adaptive_offset = adaptive_power, adaptive_offset
        self.kept = squared_cosine(num_levels).tolist()

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        x = actions.repeat_interleave(self.draws, dim=0)
        noise = draw(torch.randn, x.shape, rng=rng).to(x)
        k = draw(torch.randint, self.num_levels, (len(x),), rng=rng)
        kept = squared_cosine(self.num_levels, k.device)[k, None, None]
        signal, spread = kept.sqrt().to(x), (1 - kept).sqrt().to(x)
        z = signal * x + spread * noise
        target = {"epsilon": noise, "sample": x, "v": signal * noise - spread * x}[self.prediction]
        t = ((k + 1) / self.num_levels).to(x)
        output = core(z, t, t, context.repeat(self.draws))
        error = masked_error(output - target, valid.repeat_interleave(self.draws, dim=0))
        counted = adapted(error, self.adaptive_power, self.adaptive_offset)
        return counted.unflatten(0, (len(actions), -1)).mean(1), {"denoising_error": error.detach().mean()}

    def estimate(self, core: nn.Module, z: Tensor, k: int, context: Any) -> tuple[Tensor, Tensor]:
        """Clean action and noise (B, H, A) that the core sees in z (B, H, A) at level k."""
        t = z.new_full((len(z),), (k + 1) / self.num_levels)
        output = core(z, t, t, context)
        signal, spread = self.kept[k] ** 0.5, (1 - self.kept[k]) ** 0.5
        if self.prediction == "epsilon":
            x, noise = (z - spread * output) / signal, output
        elif self.prediction == "sample":
            x, noise = output, (z - signal * output) / spread
        else:
            x, noise = signal * z - spread * output, signal * output + spread * z
        return x.clamp(-self.clip, self.clip) if self.clip_sample else x, noise

    def guided_estimate(
        self, core: nn.Module, z: Tensor, k: int, context: Any, target: Target | None
    ) -> tuple[Tensor, Tensor]:
        """`estimate`, drawn towards `target`, if any.

        With s = sqrt(abar) + sqrt(1 - abar), z / s lies on the linear path at t = sqrt(1 - abar) / s, for which the
        guidance is defined (`inpainting`).
        """
        if target is None:
            return self.estimate(core, z, k, context)
        x, noise, towards = pull(lambda z: self.estimate(core, z, k, context), z, target)
        signal, spread = self.kept[k] ** 0.5, (1 - self.kept[k]) ** 0.5
        scale = signal + spread
        t = spread / scale
        shift = strength(t) * scale * towards
        return x + t * shift, noise - (1 - t) * shift

    def check_nfe(self, nfe: int) -> None:
        """There are no more evaluations than noise levels."""
        if not 1 <= nfe <= self.num_levels:
            raise refuse_nfe(f"between 1 and generator.num_levels={self.num_levels}", nfe)

    def draws_noise(self, nfe: int) -> bool:
        """Each ancestral step draws noise of its own; DDIM draws none."""
        return nfe == self.num_levels

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A): ancestral where `nfe` is the number of levels, else DDIM."""
        return self.inpaint(core, context, noise, nfe)

    def inpaint(
        self, core: nn.Module, context: Any, noise: Tensor, nfe: int, target: Target | None = None
    ) -> Tensor:
        """`sample`, whose estimates of the clean chunk are drawn towards `target`, if any."""
        self.check_nfe(nfe)
        walk = self.ancestral if self.draws_noise(nfe) else self.ddim
        return walk(core, context, noise, nfe, target).clamp(-self.clip, self.clip)

    def ddim(
        self, core: nn.Module, context: Any, z: Tensor, nfe: int, target: Target | None = None
    ) -> Tensor:
        """z_j = sqrt(abar_j) x + sqrt(1 - abar_j) e over trailing levels; the last estimate of x is the sample."""
        levels = trailing_levels(self.num_levels, nfe, self.last_step)
        for k, following in pairwise(levels):
            x, noise = self.guided_estimate(core, z, k, context, target)
            z = self.kept[following] ** 0.5 * x + (1 - self.kept[following]) ** 0.5 * noise
        return self.guided_estimate(core, z, levels[-1], context, target)[0]

    def ancestral(
        self, core: nn.Module, context: Any, z: Tensor, nfe: int, target: Target | None = None
    ) -> Tensor:
        """z_{k-1} drawn from the posterior given z_k and the estimate of x, with noise that follows from the first."""
        later = ancestral_noise(z, nfe - 1)
        for k in range(nfe - 1, 0, -1):
            x, _ = self.guided_estimate(core, z, k, context, target)
            before, now = self.kept[k - 1], self.kept[k]
            alpha = now / before
            of_x = before**0.5 * (1 - alpha) / (1 - now)
            of_z = alpha**0.5 * (1 - before) / (1 - now)
            std = ((1 - before) / (1 - now) * (1 - alpha)) ** 0.5
            z = of_x * x + of_z * z + std * later[nfe - 1 - k]
        return self.guided_estimate(core, z, 0, context, target)[0]
