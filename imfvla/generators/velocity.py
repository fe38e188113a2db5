"""What generators on the linear path z_t = (1 - t) x + t e share: parametrisation, weighting, intervals, sampling.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.errors import UserError
from imfvla.generators.base import LAST_STEP, TimeSampler, adapted, refuse_nfe, step_times
from imfvla.generators.inpainting import Target, pull, strength
from imfvla.nn.dual import Rows, Tape, as_written
from imfvla.nn.forward_mode import jvp
from imfvla.options import above, at_least, within

Pushes = Callable[[Tensor], Tensor]  # velocities (B, H, A) -> derivatives along them (B, H, A)
MIN_TIME = 0.02  # of training in the data form u = (z - D) / t, whose error grows without bound towards t = 0


def interpolate(x: Tensor, noise: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """z_t and the conditional velocity e - x, both (B, H, A), of data x, noise e and times t (B,)."""
    column = t[:, None, None]
    return (1 - column) * x + column * noise, noise - x


class LinearPath:
    """A velocity of the flow from noise to data, given by the core in one of two parametrisations.

    parametrisation: what the network outputs: the "velocity" u itself, or the clean action D = z - t u ("data").
    time_power: errors of velocities are weighted by t ** time_power; 2 makes them errors of the clean action.
    adaptive_power, adaptive_offset: see `adapted`.
    draws: noise draws per observation; the observation is encoded once for all of them.
    clip: normalised actions lie within [-clip, clip]; the final sample is clamped there.
    last_step: the time from which the last of several steps is taken, see `step_times`.
    """

    core_interface = "flow"

    def __init__(
        self,
        *,
        parametrisation: Literal["data", "velocity"],
        times: TimeSampler,
        time_power: Annotated[float, at_least(0)],
        adaptive_power: Annotated[float, at_least(0)],
        adaptive_offset: Annotated[float, above(0)],
        draws: int,
        clip: Annotated[float, above(0)],
        last_step: Annotated[float, LAST_STEP] | None = None,
    ) -> None:
        if parametrisation not in ("data", "velocity"):
            raise UserError(f"generator.parametrisation must be data or velocity, found {parametrisation!r}.")
        if draws < 1:
            raise UserError(f"generator.draws must be at least 1, found {draws}.")
        self.parametrisation = parametrisation
        self.times = times
        self.time_power = time_power
        self.adaptive_power, self.adaptive_offset = adaptive_power, adaptive_offset
        self.draws = draws
        self.clip = clip
        self.last_step = last_step

    def velocity(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any) -> Tensor:
        """u(z, r, t): z (B, H, A), r and t > 0 (B,) -> (B, H, A)."""
        output = core(z, t, r, context)
        if self.parametrisation == "velocity":
            return output
        return (z - output) / t[:, None, None]

    def instant_velocity(self, core: nn.Module, z: Tensor, t: Tensor, context: Any) -> Tensor:
        """v(z, t), u where the interval has no length: z (B, H, A), t (B,) -> (B, H, A)."""
        return self.velocity(core, z, t, t, context)

    def draw_times(self, count: int, rng: Stream) -> Tensor:
        """Times t (count,) to train at; in the data form none is below MIN_TIME.

        The draw is bounded, not the division: at a smaller t, (z - D) / max(t, MIN_TIME) is no velocity of the path,
        and its derivative breaks the identity that an average velocity is learned from.
        """
        t = self.times(count, rng)
        return t.clamp(min=MIN_TIME) if self.parametrisation == "data" else t

    def repeat(self, actions: Tensor, valid: Tensor, rng: Stream) -> tuple[Tensor, Tensor, Tensor]:
        """Actions, their noise and validity for all draws, those of an observation together: (B * N, ...)."""
        x = actions.repeat_interleave(self.draws, dim=0)
        noise = draw(torch.randn, x.shape, rng=rng).to(x)
        return x, noise, valid.repeat_interleave(self.draws, dim=0)

    def per_chunk(self, error: Tensor, batch: int) -> Tensor:
        """Adapted errors of all draws (B * N,) as the loss of each chunk, a mean over its draws (B,)."""
        counted = adapted(error, self.adaptive_power, self.adaptive_offset)
        return counted.unflatten(0, (batch, -1)).mean(1)

    def check_nfe(self, nfe: int) -> None:
        """Any number of steps is possible but none."""
        if nfe < 1:
            raise refuse_nfe("at least 1", nfe)

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """z_r = z_t - (t - r) u(z_t, r, t) over `nfe` intervals from t = 1 to 0."""
        self.check_nfe(nfe)
        z = noise
        for t, r in pairwise(step_times(nfe, self.last_step).to(noise)):
            ts, rs = t.expand(len(z)), r.expand(len(z))
            z = z - (t - r) * self.velocity(core, z, rs, ts, context)
        return z.clamp(-self.clip, self.clip)

    def inpaint(self, core: nn.Module, context: Any, noise: Tensor, nfe: int, target: Target) -> Tensor:
        """Euler steps of the instantaneous velocity, whose clean chunk z - t v is drawn towards `target`."""
        self.check_nfe(nfe)
        z = noise
        for t, r in pairwise(step_times(nfe, self.last_step).to(noise)):
            ts = t.expand(len(z))

            def estimate(z: Tensor, t: Tensor = t, ts: Tensor = ts) -> tuple[Tensor, Tensor]:
                v = self.instant_velocity(core, z, ts, context)
                return z - t * v, v

            _, v, towards = pull(estimate, z, target)
            z = z - (t - r) * (v - strength(float(t)) * towards)
        return z.clamp(-self.clip, self.clip)


class AverageVelocity(LinearPath):
    """An average velocity u(z_t, r, t) of the flow over [r, t], learned through its derivative along the flow.

    times: t of every draw; r = t U with U uniform, save a share `boundary_share` of draws with (r, t) = (0, 1), the
      interval of a single evaluation.
    compound_draws: how many draws of an observation are intervals; the others are the share of draws with r = t.
    The rest as in `LinearPath`.
    """

    def __init__(
        self,
        *,
        boundary_share: Annotated[float, within(0, 1)],
        draws: int,
        compound_draws: int,
        **options: Any,
    ) -> None:
        super().__init__(draws=draws, **options)
        if not 1 <= compound_draws <= draws:
            raise UserError(
                f"generator.compound_draws must lie between 1 and generator.draws={draws}, found {compound_draws}."
            )
        self.boundary_share = boundary_share
        self.compound_draws = compound_draws

    def instant_velocity(self, core: nn.Module, z: Tensor, t: Tensor, context: Any) -> Tensor:
        """v(z, t), of blocks of its own where the core has them, else u(z, t, t): z (B, H, A), t (B,) -> (B, H, A)."""
        return self.velocity(self.instant_core(core), z, t, t, context)

    def instant_core(self, core: nn.Module) -> Callable[[Tensor, Tensor, Tensor, Any], Tensor]:
        """What answers (z, t, r, context) as the blocks of v do, whatever r."""
        if self.core_interface == "flow":
            return lambda z, t, r, context: core(z, t, t, context)
        return lambda z, t, r, context: core.instant(z, t, context)

    def linearise(
        self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any, rows: Rows
    ) -> tuple[Tensor, Pushes]:
        """u(z, r, t), and what gives du/dt of its `rows` along (v, 0, 1) in (z, r, t) for v of these (paper eq. 6).

        u is under autograd as in `velocity`, du/dt without gradient and in full precision. It works once. A core that
        `takes_duals` is called once. Another one is called again, in forward mode; and so is any under autocast, since
        in bfloat16 the derivative would be off by more than half a percent.
        """
        if not getattr(core, "takes_duals", False):
            return self.velocity(core, z, r, t, context), self._forward_mode(core, z, r, t, context, rows)
        if torch.is_autocast_enabled(z.device.type):
            return self.velocity(core, z, r, t, context), self._in_full(core, z, r, t, context, rows)
        tape = Tape(rows)
        moving, start, end = tape.input(z), tape.input(r), tape.input(t)
        with as_written():
            output = core(moving, end, start, context)
        u = output.value
        if self.parametrisation == "data":
            u = (z - u) / t[:, None, None]
        u_fixed, t_fixed = u.detach()[rows], t[rows]

        def push(v: Tensor) -> Tensor:
            change = tape.push(
                output, (moving, v), (start, torch.zeros_like(t_fixed)), (end, torch.ones_like(t_fixed))
            )
            return (
                change
                if self.parametrisation == "velocity"
                else (v - change - u_fixed) / t_fixed[:, None, None]
            )

        return u, push

    def _in_full(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any, rows: Rows) -> Pushes:
        def push(v: Tensor) -> Tensor:
            with torch.no_grad(), torch.autocast(z.device.type, enabled=False):
                inputs = z[rows], r[rows], t[rows], context.rows(rows).detach(z.dtype)
                return self.linearise(core, *inputs, slice(None))[1](v)

        return push

    def _forward_mode(
        self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any, rows: Rows
    ) -> Pushes:
        fixed = context.rows(rows).detach(z.dtype)

        def push(v: Tensor) -> Tensor:
            inputs = z[rows], r[rows], t[rows]
            tangents = v, torch.zeros_like(inputs[1]), torch.ones_like(inputs[2])
            return jvp(lambda z, r, t: self.velocity(core, z, r, t, fixed), inputs, tangents)[1]

        return push

    def intervals(self, count: int, rng: Stream) -> tuple[Tensor, Tensor]:
        """Times r <= t (count,) of the compound loss."""
        t = self.draw_times(count, rng)
        r = t * draw(torch.rand, count, rng=rng)
        boundary = draw(torch.rand, count, rng=rng) < self.boundary_share
        return r.masked_fill(boundary, 0.0), t.masked_fill(boundary, 1.0)

    def compound_rows(self, batch: int, device: torch.device) -> Tensor:
        """Which rows of (B * N, ...) are the first `compound_draws` draws of their observation."""
        rows = torch.arange(batch * self.draws, device=device).unflatten(0, (batch, self.draws))
        return rows[:, : self.compound_draws].flatten()
