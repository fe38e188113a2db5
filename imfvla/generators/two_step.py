"""Regression in two steps: a first answer, and the same network's correction of it (MIP, arXiv 2512.01809).

The minimal iterative policy is flow matching without its distribution. One network answers with the clean action at two
times: from zeros at t = 1, and from the action with a little noise at `level`, both by a squared error. In a rollout
the second call is given the first one's answer, shrunk as in training but without noise. All of it is deterministic:
what is learned are means, and the source's claim is that such a policy does as well as a sampler.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.generators.base import masked_error, refuse_nfe
from imfvla.generators.regression import Regression
from imfvla.generators.velocity import interpolate
from imfvla.options import Limit, above, at_least

INSIDE = Limit("between 0 and 1", lambda level: 0 < level < 1)


class TwoStepRegression:
    """Learns a mean and its correction. The core is given zeros at t = 1, r = 0, then r = t = `level`.

    level: time of the second call; the source's t* = 0.9 is 0.1 here, where t = 1 is noise.
    draws: noise draws per observation of the second call; the observation is encoded once for all of them.
    clip: normalised actions lie within [-clip, clip]; the prediction is clamped there.
    """

    core_interface = "flow"
    uses_noise = False

    def __init__(
        self,
        *,
        level: Annotated[float, INSIDE],
        draws: Annotated[int, at_least(1)],
        clip: Annotated[float, above(0)],
    ) -> None:
        self.first = Regression(clip=clip, power=2)
        self.level, self.draws, self.clip = level, draws, clip

    def correct(self, core: nn.Module, context: Any, z: Tensor) -> Tensor:
        """The clean action that the core sees in z (B, H, A) at `level`: (B, H, A)."""
        t = z.new_full((len(z),), self.level)
        return core(z, t, t, context)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of both answers for each chunk (B,), each with weight 1."""
        first, logs = self.first.loss(core, context, actions, valid, rng)
        x = actions.repeat_interleave(self.draws, dim=0)
        noise = draw(torch.randn, x.shape, rng=rng).to(x)
        z, _ = interpolate(x, noise, x.new_full((len(x),), self.level))
        answer = self.correct(core, context.repeat(self.draws), z)
        error = masked_error(answer - x, valid.repeat_interleave(self.draws, dim=0))
        second = error.unflatten(0, (len(actions), -1)).mean(1)
        return first + second, logs | {"correction_error": second.detach().mean()}

    def check_nfe(self, nfe: int) -> None:
        """There are two evaluations."""
        if nfe != 2:
            raise refuse_nfe("2 with generator=two_step (one answer and one correction)", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """The corrected chunk (B, H, A), whatever the noise."""
        self.check_nfe(nfe)
        first = self.first.predict(core, context, noise)
        return self.correct(core, context, (1 - self.level) * first).clamp(-self.clip, self.clip)
