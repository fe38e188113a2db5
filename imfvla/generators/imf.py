"""Improved Mean Flow: actions from noise in one to three evaluations (paper section 3.2; arXiv 2512.02012).

The network gives the average velocity u(z_t, r, t) of the flow over [r, t]. In training the compound
V = u + (t - r) sg(du/dt) is regressed on the conditional velocity e - x (paper eq. 7), where du/dt is the derivative
along the marginal flow: the Jacobian-vector product of u in the direction (v, 0, 1) (eq. 6), v = u(z_t, t, t) from the
same network. The gradient flows through the primal u alone.

Beside the compound loss, the instantaneous case u(z_t, t, t) that the tangent needs anyway is regressed on e - x too
("dual pass", arXiv 2608.16153).

Shapes: B batch, N draws per observation, H steps, A action.
"""

from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.generators.base import TimeSampler, masked_error
from imfvla.nn.forward_mode import jvp

MIN_TIME = 0.02  # u = (z - D) / t: below this time the division stops


class ImprovedMeanFlow:
    """Learns and samples an average velocity.

    parametrisation: what the network outputs: the "velocity" u itself, or the clean action D = z - t u ("data").
    times: t of every draw; r = t U with U uniform, save a share `boundary_share` of draws with (r, t) = (0, 1), the
      interval of a single evaluation.
    instant_weight: weight of the loss on u(z_t, t, t), the flow-matching part.
    compound_target: "sample" regresses V on e - x (paper); "network" on v, the same network's estimate of its mean.
    time_power: errors of velocities are weighted by t ** time_power; 2 makes them errors of the clean action.
    draws: noise draws per observation; the observation is encoded once for all of them.
    compound_draws: how many of them enter the compound loss too; the others are the share of draws with r = t.
    clip: normalised actions lie within [-clip, clip]; the final sample is clamped there.
    """

    def __init__(
        self,
        *,
        parametrisation: Literal["data", "velocity"],
        times: TimeSampler,
        boundary_share: float,
        instant_weight: float,
        compound_target: Literal["sample", "network"],
        time_power: float,
        adaptive_power: float,
        adaptive_offset: float,
        draws: int,
        compound_draws: int,
        clip: float,
    ) -> None:
        if parametrisation not in ("data", "velocity"):
            raise UserError(f"generator.parametrisation must be data or velocity, found {parametrisation!r}.")
        if compound_target not in ("sample", "network"):
            raise UserError(
                f"generator.compound_target must be sample or network, found {compound_target!r}."
            )
        if not 1 <= compound_draws <= draws:
            raise UserError(
                f"generator.compound_draws must lie between 1 and generator.draws={draws}, found {compound_draws}."
            )
        self.parametrisation = parametrisation
        self.times = times
        self.boundary_share = boundary_share
        self.instant_weight = instant_weight
        self.compound_target = compound_target
        self.time_power = time_power
        self.adaptive_power, self.adaptive_offset = adaptive_power, adaptive_offset
        self.draws, self.compound_draws = draws, compound_draws
        self.clip = clip

    def velocity(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any) -> Tensor:
        """u(z, r, t): z (B, H, A), r and t (B,) -> (B, H, A)."""
        output = core(z, t, r, context)
        if self.parametrisation == "velocity":
            return output
        return (z - output) / t.clamp(min=MIN_TIME)[:, None, None]

    def derivative(
        self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, v: Tensor, context: Any
    ) -> tuple[Tensor, Tensor]:
        """u and du/dt along (v, 0, 1) in (z, r, t) (paper eq. 6), without gradient."""
        return jvp(
            lambda z, r, t: self.velocity(core, z, r, t, context),
            (z, r, t),
            (v, torch.zeros_like(r), torch.ones_like(t)),
        )

    def intervals(self, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        """Times r <= t (count,) of the compound loss."""
        t = self.times(count, rng)
        r = t * torch.rand(count, generator=rng)
        boundary = torch.rand(count, generator=rng) < self.boundary_share
        return r.masked_fill(boundary, 0.0), t.masked_fill(boundary, 1.0)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        batch = len(actions)
        context = context.repeat(self.draws)
        x = actions.repeat_interleave(self.draws, dim=0)
        valid = valid.repeat_interleave(self.draws, dim=0)
        noise = torch.randn(x.shape, generator=rng).to(x)
        r, t = (time.to(x) for time in self.intervals(len(x), rng))
        some = (
            torch.arange(len(x), device=x.device)
            .unflatten(0, (batch, self.draws))[:, : self.compound_draws]
            .flatten()
        )
        column = t[:, None, None]
        z = (1 - column) * x + column * noise
        target = noise - x

        v = self.velocity(core, z, t, t, context)
        instant_error = t**self.time_power * masked_error(v - target, valid)

        z, r, t, context, valid = z[some], r[some], t[some], context.rows(some), valid[some]
        v_fixed = v.detach()[some]
        u = self.velocity(core, z, r, t, context)
        _, dudt = self.derivative(core, z, r, t, v_fixed, context.detach(z.dtype))
        change = (t - r)[:, None, None] * dudt
        compound_target = target[some] if self.compound_target == "sample" else v_fixed
        compound_error = t**self.time_power * masked_error(u + change - compound_target, valid)

        loss = self.instant_weight * self.adapt(instant_error).unflatten(0, (batch, -1)).mean(1)
        loss = loss + self.adapt(compound_error).unflatten(0, (batch, -1)).mean(1)
        return loss, {
            "instant_error": instant_error.detach().mean(),
            "compound_error": compound_error.detach().mean(),
            "change_rms": change.square().mean().sqrt(),
        }

    def adapt(self, error: Tensor) -> Tensor:
        """error / sg(error + offset) ** power: large errors count for less (arXiv 2505.13447)."""
        if self.adaptive_power == 0:
            return error
        return error / (error.detach() + self.adaptive_offset) ** self.adaptive_power

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """z_r = z_t - (t - r) u(z_t, r, t) over `nfe` equal intervals from t = 1 to 0."""
        times = torch.linspace(1, 0, nfe + 1).to(noise)
        z = noise
        for t, r in pairwise(times):
            ts, rs = t.expand(len(z)), r.expand(len(z))
            z = z - (t - r) * self.velocity(core, z, rs, ts, context)
        return z.clamp(-self.clip, self.clip)
