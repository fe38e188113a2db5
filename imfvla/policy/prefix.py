"""Actions that are decided before a chunk is asked for, and policies that learn to go on from them.

While a policy computes, a robot that continues executes the first actions of what the new chunk covers. They are the
prefix of that chunk. `generators/inpainting.py` corrects a sample towards it; a policy with `horizon.prefix_max` has
learned to go on from it (arXiv 2512.05964): in training the first d actions are given, with d drawn for each chunk.

Generators and cores know nothing of it. The core that they call has the given actions in place of those of its noisy
input, whatever the time, and the last context token, which every core hands to all action tokens, says which they are.
They have no error of their own, and are written over those of the sample.

Shapes: B observations, N draws of each, Tp predicted steps, A action, L context tokens, D width.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.nn.dual import Dual, Same


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of the actions that a chunk covers, when it is asked for."""

    actions: (
        Tensor  # (Tp, A) in physical units: what the robot does by the chunk it has; beyond its end, anything
    )
    decided: int  # of them, how many will have been executed when the new chunk is there
    weights: Tensor | None = (
        None  # (Tp,), how far a sample is drawn to each; None: the decided ones are conditions
    )


class PrefixInput(nn.Module):
    """Adds to the last context token what the given actions are, at most `most`; without any it says that, too."""

    def __init__(self, most: int, channels: int, width: int) -> None:
        super().__init__()
        self.most = most
        self.given = nn.Sequential(
            nn.Linear(most * (channels + 1), width), nn.SiLU(), nn.Linear(width, width)
        )

    def draw(self, batch: int, rng: Stream) -> Tensor:
        """How many actions are given in each of a batch of chunks (B,): 0 to `most`, all equally often."""
        return draw(torch.randint, self.most + 1, (batch,), rng=rng)

    def forward(self, tokens: Tensor, actions: Tensor, given: Tensor) -> Tensor:
        """Tokens (B, L, D), normalised actions (B, Tp, A) and which are given (B, Tp) -> tokens (B, L, D)."""
        mask = given[:, : self.most].unsqueeze(-1)
        shown = torch.where(mask, actions[:, : self.most], 0.0)
        last = tokens[:, -1:] + self.given(torch.cat((shown, mask.to(shown)), dim=-1).flatten(1)).unsqueeze(1)
        return torch.cat((tokens[:, :-1], last), dim=1)


def first_steps(counts: Tensor, steps: int) -> Tensor:
    """Which of `steps` steps are the first `counts` (B,): bool (B, steps)."""
    return torch.arange(steps, device=counts.device) < counts.unsqueeze(1)


@dataclass(frozen=True, slots=True)
class GivenContext:
    """A core's context, and the actions that are given with it."""

    context: Any
    actions: Tensor  # (B, Tp, A), normalised
    given: Tensor  # bool (B, Tp, 1)

    def repeat(self, times: int) -> "GivenContext":
        return GivenContext(
            self.context.repeat(times),
            self.actions.repeat_interleave(times, dim=0),
            self.given.repeat_interleave(times, dim=0),
        )

    def rows(self, index: Tensor | slice) -> "GivenContext":
        return GivenContext(self.context.rows(index), self.actions[index], self.given[index])

    def detach(self, dtype: torch.dtype) -> "GivenContext":
        return GivenContext(self.context.detach(dtype), self.actions.to(dtype), self.given)

    def put(self, x: Same) -> Same:
        """x (B, Tp, A) with the given actions in their places, which a derivative along x does not reach."""
        if isinstance(x, Dual):
            given = self.given[x.tape.rows]
            return x.tape.add(self.put(x.value), lambda tangent: tangent.masked_fill(given, 0), x)
        return torch.where(self.given, self.actions.to(x.dtype), x)


class GivenCore:
    """A core of the kind "flow", with or without a v-head, whose noisy input has the given actions in their places."""

    def __init__(self, core: nn.Module) -> None:
        self._core = core
        self.takes_duals = getattr(core, "takes_duals", False)

    def __call__(self, x: Same, t: Same, r: Same, context: GivenContext) -> Same:
        return self._core(context.put(x), t, r, context.context)

    def instant(self, x: Same, t: Same, context: GivenContext) -> Same:
        return self._core.instant(context.put(x), t, context.context)
