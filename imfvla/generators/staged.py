"""Mean Flow in two stages: the flow first, then its average velocity, learned along the flow's own path.

The instantaneous velocity v is learned by flow matching in all steps, by action blocks of its own (the auxiliary head
of arXiv 2512.02012). From a share `average_from` of the training on, other blocks learn the average velocity

    u(z_t, r, t) = 1 / (t - r) * integral of v(z_s, s) ds from r to t     (paper eq. 4)

along the path of v from z_t, whose mean is taken over `path_steps` Euler steps without gradient. They begin with the
weights of v's blocks and read the same context without changing it, so that v is what flow matching alone would learn.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.generators.base import masked_error
from imfvla.generators.velocity import AverageVelocity, interpolate
from imfvla.options import SHARE_BELOW_1, above, at_least


class StagedMeanFlow(AverageVelocity):
    """Learns and samples an average velocity.

    velocity_head: whether v has action blocks of its own; else u and v share theirs.
    average_from: share of the training after which the average velocity is learned, in [0, 1).
    path_steps: Euler steps along the flow from which an average velocity is taken.
    average_weight: of its loss.
    boundary_share: of the intervals, the share that is (0, 1). At 1, one step is taken with u and more with v.
    The rest as in `AverageVelocity`: `compound_draws` is how many draws of an observation are intervals.
    """

    def __init__(
        self,
        *,
        velocity_head: bool,
        average_from: Annotated[float, SHARE_BELOW_1],
        path_steps: Annotated[int, at_least(1)],
        average_weight: Annotated[float, above(0)],
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.core_interface = "flow and v-head" if velocity_head else "flow"
        self.average_from, self.path_steps, self.average_weight = average_from, path_steps, average_weight
        self.learns_average = False

    def first_steps(self, core: nn.Module, steps: int) -> dict[str, int]:
        """The step at which the blocks of the average velocity begin to learn, by the names of their parameters."""
        if self.core_interface == "flow":
            return {}
        first = self._first_step(steps)
        return {name: first for name, _ in core.named_parameters() if name.startswith("average.")}

    def begin_step(self, core: nn.Module, step: int, steps: int) -> None:
        """Starts the second stage where its first step is due."""
        first = self._first_step(steps)
        if step == first and self.core_interface == "flow and v-head":
            core.start_average()
        self.learns_average = step >= first

    def _first_step(self, steps: int) -> int:
        return round(self.average_from * steps)

    def path_velocity(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any) -> Tensor:
        """Mean of v along the flow from z at t to r, without gradient: (B, H, A)."""
        total = torch.zeros_like(z)
        length = ((t - r) / self.path_steps)[:, None, None]
        with torch.no_grad():
            for k in range(self.path_steps):
                v = self.instant_velocity(core, z, t + (r - t) * (k / self.path_steps), context)
                total, z = total + v, z - length * v
        return total / self.path_steps

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A): one step of u; more of them too, or of v where u has learned the whole interval alone."""
        takes_average = nfe == 1 or self.boundary_share < 1
        return super().sample(core if takes_average else self.instant_core(core), context, noise, nfe)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        batch = len(actions)
        context, x, noise, valid = self.repeat(context, actions, valid, rng)
        t = self.draw_times(len(x), rng).to(x)
        z, target = interpolate(x, noise, t)
        v = self.instant_velocity(core, z, t, context)
        instant_error = t**self.time_power * masked_error(v - target, valid)
        loss = self.per_chunk(instant_error, batch)
        logs = {"instant_error": instant_error.detach().mean()}
        if not self.learns_average:
            return loss, logs | {"average_error": torch.zeros_like(logs["instant_error"])}
        some = self.compound_rows(batch, x.device)
        r, t = (time.to(x) for time in self.intervals(len(some), rng))
        z, _ = interpolate(x[some], noise[some], t)
        context, valid = context.rows(some).detach(z.dtype), valid[some]
        u = self.velocity(core, z, r, t, context)
        path = self.path_velocity(core, z, r, t, context)
        average_error = t**self.time_power * masked_error(u - path, valid)
        loss = loss + self.average_weight * self.per_chunk(average_error, batch)
        return loss, logs | {"average_error": average_error.detach().mean()}
