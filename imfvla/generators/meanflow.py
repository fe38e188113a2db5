"""Mean Flow, the original: actions from noise in few evaluations (arXiv 2505.13447).

The network gives the average velocity u(z_t, r, t) of the flow over [r, t]. It is regressed on
sg(v_c - (t - r) du/dt), where du/dt is taken along the conditional velocity v_c = e - x of the drawn pair, not along
the marginal one as in `imf`. Draws with r = t are flow matching and cost no derivative.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from typing import Any

from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.generators.base import masked_error
from imfvla.generators.velocity import AverageVelocity, Pushes, interpolate


class MeanFlow(AverageVelocity):
    """Learns and samples an average velocity; `compound_draws` of `draws` have r < t, the others r = t."""

    def target(self, push: Pushes, r: Tensor, t: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """v - (t - r) du/dt, which u(z, r, t) is regressed on, and (t - r) du/dt; `push` gives du/dt along v."""
        change = (t - r)[:, None, None] * push(v)
        return v - change, change

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        batch = len(actions)
        x, noise, valid = self.repeat(actions, valid, rng)
        context = context.repeat(self.draws)
        r, t = (time.to(x) for time in self.intervals(len(x), rng))
        z, v = interpolate(x, noise, t)
        some = self.compound_rows(batch, x.device)
        r = t.index_copy(0, some, r[some])
        u, push = self.linearise(core, z, r, t, context, some)
        target, change = self.target(push, r[some], t[some], v[some])
        error = t**self.time_power * masked_error(u - v.index_copy(0, some, target), valid)
        loss = self.per_chunk(error, batch)
        return loss, {
            "compound_error": error.detach()[some].mean(),
            "change_rms": change.square().mean().sqrt(),
        }
