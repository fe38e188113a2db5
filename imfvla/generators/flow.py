"""Flow matching: the instantaneous velocity regressed on e - x, Euler steps from noise to data (arXiv 2210.02747).

At the optimum one step from t = 1 gives the conditional mean of the action, whatever the noise; more of them give
samples. A trained network is not at the optimum: what its single step gives does depend on the noise
(docs/results.md, "Samples and averages"). With the clean action as output and times near 1 this is the cheapest rival
of Mean Flow (arXiv 2606.05737): no derivative is taken.

Shapes: B batch, N draws per observation, H steps, A action.
"""

from typing import Any

from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.generators.base import masked_error
from imfvla.generators.velocity import LinearPath, interpolate


class FlowMatching(LinearPath):
    """Learns v(z_t, t) = E[e - x | z_t] at times drawn from `times`. The core is given r = t always."""

    def velocity(self, core: nn.Module, z: Tensor, r: Tensor, t: Tensor, context: Any) -> Tensor:
        """v(z, t), whatever the step's end r: z (B, H, A), t (B,) -> (B, H, A)."""
        return super().velocity(core, z, t, t, context)

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,), a mean over its draws."""
        x, noise, valid = self.repeat(actions, valid, rng)
        context = context.repeat(self.draws)
        t = self.draw_times(len(x), rng).to(x)
        z, target = interpolate(x, noise, t)
        error = t**self.time_power * masked_error(self.velocity(core, z, t, t, context) - target, valid)
        loss = self.per_chunk(error, len(actions))
        return loss, {"velocity_error": error.detach().mean()}
