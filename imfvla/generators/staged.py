"""Mean Flow in two stages: the flow first, then its average velocity, learned along the flow's own path.

In the first stage encoder and core learn the instantaneous velocity v by flow matching. In the second one these stay as
they are, and action blocks of its own (the auxiliary head of arXiv 2512.02012, with the roles exchanged) learn the
average velocity

    u(z_t, r, t) = 1 / (t - r) * integral of v(z_s, s) ds from r to t     (paper eq. 4)

along the path of v from z_t, whose mean is taken over `path_steps` Euler steps. They begin with the weights of v's
blocks and read the same context.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from itertools import pairwise
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.errors import UserError
from imfvla.generators.base import masked_error, step_times
from imfvla.generators.velocity import AverageVelocity, interpolate
from imfvla.options import SHARE_BELOW_1, at_least, one_of


class StagedMeanFlow(AverageVelocity):
    """Learns and samples an average velocity.

    average_from: share of the training after which the average velocity is learned, in [0, 1).
    path_steps: Euler steps along the flow from which an average velocity is taken, those that `sample` takes with v.
    boundary_share: of the intervals, the share that is (0, 1). At 1, one step is taken with u and more with v.
    velocity_head: true, as the average velocity has action blocks of its own; the core takes this key from here.
    The rest as in `AverageVelocity`; all draws of the second stage are intervals.
    """

    core_interface = "flow and v-head"

    def __init__(
        self,
        *,
        average_from: Annotated[float, SHARE_BELOW_1],
        path_steps: Annotated[int, at_least(1)],
        velocity_head: Annotated[bool, one_of(True)],
        draws: int,
        **options: Any,
    ) -> None:
        super().__init__(draws=draws, compound_draws=draws, **options)
        assert velocity_head
        self.average_from, self.path_steps = average_from, path_steps
        self._path_times: list[float] = step_times(path_steps, self.last_step).tolist()
        self.learns_average: bool | None = None  # None: not told of a step yet

    def span(self, name: str, steps: int) -> tuple[float, float]:
        """The steps [first, end) of `steps` in which the parameter `name` of a policy learns."""
        first = self._first_step(steps)
        return (first, steps) if name.startswith("core.average.") else (0, first)

    def begin_step(self, core: nn.Module, step: int, steps: int) -> None:
        """Starts the second stage where its first step is due."""
        first = self._first_step(steps)
        if step == first:
            core.start_average()
        self.learns_average = step >= first

    def check_nfe(self, nfe: int) -> None:
        """Any number of steps is possible, one with weights from the second stage alone."""
        super().check_nfe(nfe)
        if self.learns_average is False and (nfe == 1 or self.boundary_share < 1):
            raise UserError(
                f"nfe={nfe} follows the average velocity, which these weights do not have yet: it is learned in the "
                f"last {1 - self.average_from:.0%} of the training. Take later weights, or more steps."
            )

    def _first_step(self, steps: int) -> int:
        return min(round(self.average_from * steps), steps - 1)  # the last one at least is of it

    def path_velocity(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any) -> Tensor:
        """Mean of v along the flow from z at t to r, without gradient: (B, H, A)."""
        mean, length = torch.zeros_like(z), (t - r)[:, None, None]
        with torch.no_grad():
            for begin, end in pairwise(self._path_times):
                v = (begin - end) * self.instant_velocity(core, z, r + (t - r) * begin, context)
                mean, z = mean + v, z - length * v
        return mean

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A): one step of u; more of them too, or of v where u has learned the whole interval alone."""
        takes_average = nfe == 1 or self.boundary_share < 1
        return super().sample(core if takes_average else self.instant_core(core), context, noise, nfe)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws: of v in the first stage, of u in the second."""
        batch = len(actions)
        x, noise, valid = self.repeat(actions, valid, rng)
        context = context.repeat(self.draws)
        if self.learns_average:
            r, t = (time.to(x) for time in self.intervals(len(x), rng))
            z, _ = interpolate(x, noise, t)
            context = context.detach(z.dtype)
            target = self.path_velocity(core, z, r, t, context)
            velocity = self.velocity(core, z, r, t, context)
        else:
            t = self.draw_times(len(x), rng).to(x)
            z, target = interpolate(x, noise, t)
            velocity = self.instant_velocity(core, z, t, context)
        error = t**self.time_power * masked_error(velocity - target, valid)
        mean, none = error.detach().mean(), torch.zeros((), device=error.device)
        errors = (none, mean) if self.learns_average else (mean, none)
        return self.per_chunk(error, batch), dict(
            zip(("instant_error", "average_error"), errors, strict=True)
        )
