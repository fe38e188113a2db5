"""What every action generator offers to the policy, and the time samplers that they share.

Convention everywhere: t = 0 is data, t = 1 is noise, z_t = (1 - t) x + t e, velocity e - x.
Shapes: B batch, H steps, A action.
"""

from collections.abc import Callable
from typing import Annotated, Any, Protocol

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.options import above, at_least, within


class Generator(Protocol):
    """One algorithm: how to learn from chunks, how to turn noise into a chunk. Works on normalised actions."""

    core_interface: str  # how it calls the core: "flow" is core(z, t, r, context); "style" is ACT's

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,) for actions (B, H, A) and valid (B, H), and scalars to log."""
        ...

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A) from noise (B, H, A) with `nfe` calls of the core: a pure function."""
        ...

    def check_nfe(self, nfe: int) -> None:
        """Raises UserError where `sample` cannot make do with `nfe` evaluations."""
        ...


LAST_STEP = within(0.01, 0.99)  # a time between noise and data
TimeSampler = Callable[[int, torch.Generator], Tensor]  # how many, from which stream -> (n,) in [0, 1]


class UniformTimes:
    """t ~ U[0, 1]."""

    def __call__(self, count: int, rng: torch.Generator) -> Tensor:
        return torch.rand(count, generator=rng)


class BetaTimes:
    """t = 1 - span (1 - B), B ~ Beta(alpha, 1), drawn as U^(1/alpha) (SmolVLA, arXiv 2506.01844: 1.5 and 0.999)."""

    def __init__(self, alpha: Annotated[float, above(0)], span: Annotated[float, within(0, 1)]) -> None:
        self.alpha, self.span = alpha, span

    def __call__(self, count: int, rng: torch.Generator) -> Tensor:
        return 1 - self.span * (1 - torch.rand(count, generator=rng) ** (1 / self.alpha))


class LogitNormalTimes:
    """t = sigmoid(mean + std n), n ~ N(0, 1) (arXiv 2505.13447)."""

    def __init__(self, mean: float, std: Annotated[float, at_least(0)]) -> None:
        self.mean, self.std = mean, std

    def __call__(self, count: int, rng: torch.Generator) -> Tensor:
        return torch.sigmoid(self.mean + self.std * torch.randn(count, generator=rng))


class HighNoiseTimes:
    """t = 1 - span U^power: most times near 1, where the noisy action does not give the answer away.

    At low noise a network can copy the action from its input and learns nothing from the pictures.
    """

    def __init__(
        self, span: Annotated[float, within(0, 1)] = 0.98, power: Annotated[float, above(0)] = 2.0
    ) -> None:
        self.span, self.power = span, power

    def __call__(self, count: int, rng: torch.Generator) -> Tensor:
        return 1 - self.span * torch.rand(count, generator=rng) ** self.power


def step_times(nfe: int, last_step: float | None = None) -> Tensor:
    """Times (nfe + 1,) from noise, 1, to data, 0: equal steps; with `last_step` the last of several starts there.

    Two steps then are one to the mean and one from little noise (arXiv 2512.01809 refines from 0.1).
    """
    if last_step is None:
        return torch.linspace(1, 0, nfe + 1)
    return torch.cat((torch.linspace(1, last_step, nfe), torch.zeros(1)))


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of (B, H, A) over the valid steps and all channels: (B,)."""
    per_step = values.mean(-1)
    return (per_step * valid).sum(-1) / valid.sum(-1).clamp(min=1)


def masked_error(error: Tensor, valid: Tensor) -> Tensor:
    """Mean of squared errors (B, H, A) over the valid steps and all channels: (B,)."""
    return masked_mean(error.square(), valid)


def refuse_nfe(wanted: str, nfe: int) -> UserError:
    """The error of a generator that needs `wanted` calls of the core and was asked for `nfe`."""
    return UserError(f"nfe, the number of network steps, must be {wanted}, found {nfe}.")
