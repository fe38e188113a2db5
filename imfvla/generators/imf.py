"""Improved Mean Flow: actions from noise in one to three evaluations (paper section 3.2; arXiv 2512.02012).

The network gives the average velocity u(z_t, r, t) of the flow over [r, t]. In training the compound
V = u + (t - r) sg(du/dt) is regressed on the conditional velocity e - x (paper eq. 7), where du/dt is the derivative
along the marginal flow: the Jacobian-vector product of u in the direction (v, 0, 1) (eq. 6), v = u(z_t, t, t) from the
same network. The gradient flows through the primal u alone.

Beside the compound loss, the instantaneous velocity that the tangent needs anyway is regressed on e - x too ("dual
pass", arXiv 2608.16153). It is the boundary case u(z_t, t, t), or comes from blocks of its own.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from typing import Annotated, Any, Literal

import torch
from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.errors import UserError
from imfvla.generators.base import masked_error
from imfvla.generators.velocity import AverageVelocity, interpolate
from imfvla.options import at_least


class ImprovedMeanFlow(AverageVelocity):
    """Learns and samples an average velocity.

    v_from: where v comes from: "boundary", u(z_t, t, t), or "head", action blocks of its own in the core.
    instant_weight: weight of the loss on v, the flow-matching part.
    compound_target: "sample" regresses V on e - x (paper); "network" on v, the same network's estimate of its mean.
    compound_draws: how many draws of an observation enter the compound loss too.
    The rest as in `AverageVelocity`.
    """

    def __init__(
        self,
        *,
        v_from: Literal["boundary", "head"],
        instant_weight: Annotated[float, at_least(0)],
        compound_target: Literal["sample", "network"],
        **options: Any,
    ) -> None:
        super().__init__(**options)
        if v_from not in ("boundary", "head"):
            raise UserError(f"generator.v_from must be boundary or head, found {v_from!r}.")
        if compound_target not in ("sample", "network"):
            raise UserError(
                f"generator.compound_target must be sample or network, found {compound_target!r}."
            )
        self.v_from = v_from
        self.core_interface = "flow and v-head" if v_from == "head" else "flow"
        self.instant_weight = instant_weight
        self.compound_target = compound_target

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        batch = len(actions)
        x, noise, valid = self.repeat(actions, valid, rng)
        r, t = (time.to(x) for time in self.intervals(len(x), rng))
        z, target = interpolate(x, noise, t)
        some = self.compound_rows(batch, x.device)

        v, u, dudt = self.velocities(core, z, r, t, context, some)
        instant_error = t**self.time_power * masked_error(v - target, valid)

        r, t, valid = r[some], t[some], valid[some]
        v_fixed = v.detach()[some]
        change = (t - r)[:, None, None] * dudt
        compound_target = target[some] if self.compound_target == "sample" else v_fixed
        compound_error = t**self.time_power * masked_error(u + change - compound_target, valid)

        loss = self.instant_weight * self.per_chunk(instant_error, batch)
        loss = loss + self.per_chunk(compound_error, batch)
        return loss, {
            "instant_error": instant_error.detach().mean(),
            "compound_error": compound_error.detach().mean(),
            "change_rms": change.square().mean().sqrt(),
        }

    def velocities(
        self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any, some: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """v (B * N, H, A), u of the rows `some`, and du/dt along v of these, for a context of the B observations.

        Where v is u at r = t, one pass of the core answers both.
        """
        if self.v_from == "head":
            v = self.instant_velocity(core, z, t, context.repeat(self.draws))
            own = context.repeat(self.compound_draws)
            u, push = self.linearise(core, z[some], r[some], t[some], own, slice(None))
            return v, u, push(v.detach()[some])
        observations = torch.arange(len(z), device=z.device) // self.draws
        both, push = self.linearise(
            core,
            torch.cat((z, z[some])),
            torch.cat((t, r[some])),
            torch.cat((t, t[some])),
            context.rows(torch.cat((observations, observations[some]))),
            slice(len(z), None),
        )
        v, u = both[: len(z)], both[len(z) :]
        return v, u, push(v.detach()[some])
