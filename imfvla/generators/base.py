"""What every action generator offers to the policy, and the time samplers that they share.

Convention everywhere: t = 0 is data, t = 1 is noise, z_t = (1 - t) x + t e, velocity e - x.
Shapes: B batch, H steps, A action.
"""

import hashlib
from collections.abc import Callable
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from imfvla.draws import Stream, draw
from imfvla.errors import UserError
from imfvla.options import above, at_least, within


class Generator(Protocol):
    """One algorithm: how to learn from chunks, how to turn noise into a chunk. Works on normalised actions.

    With `core_interface = "flow"` the core is called as `core(z, t, r, context)` and gives (B, H, A). z (B, H, A) is
    the noisy chunk, t (B,) its time and r (B,) where the step from t ends: 0 <= r <= t <= 1. A method without an
    interval passes r = t, one that goes all the way to data r = 0. "flow and v-head" has `core.instant(z, t, context)`
    too. "style" is ACT's (`imfvla.nn.act.ActCore`).

    `context` is what the core made of B observations. The generator hands it on, and may call
    - `context.repeat(N)`: (B * N, ...), the N draws of an observation side by side, as `repeat_interleave` does,
    - `context.rows(index)`: the rows that a slice or a tensor of numbers names, also several times,
    - `context.detach(dtype)`: without gradient, in the precision of a derivative or of targets.

    Generators of this package have `clip` too: normalised actions are taken to lie within [-clip, clip], and `sample`
    clamps the chunk to that.

    Optional, where a generator has them: `DrawsNoise`, `HasStages`, `inpainting.Inpaints`, `uses_noise`, false where
    chunks do not depend on the noise, and `times`, a `TimeSampler` that the config group `generator/times` chooses.
    """

    core_interface: str  # how it calls the core: "flow", "flow and v-head" or "style"

    def loss(
        self, core: nn.Module, context: Any, actions: Tensor, valid: Tensor, rng: Stream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of each chunk (B,) for actions (B, H, A) and valid (B, H), and scalars without gradient to log.

        `rng` is of the actions' device, or of the CPU: draw where it is, then move, as in
        `draw(torch.randn, x.shape, rng=rng).to(x)` with `imfvla.draws.draw`. Of several draws (B * N, H, A) those of an
        observation lie side by side, and the loss is their mean. A loss reads no number of a tensor, such as by
        `.item()`, and makes none of Python's numbers: a GPU would be waited for.
        """
        ...

    def sample(self, core: nn.Module, context: Any, noise: Tensor, nfe: int) -> Tensor:
        """A chunk (B, H, A) from noise (B, H, A) with `nfe` calls of the core: a pure function."""
        ...

    def check_nfe(self, nfe: int) -> None:
        """Raises UserError where `sample` cannot make do with `nfe` evaluations."""
        ...


@runtime_checkable
class DrawsNoise(Protocol):
    """Optional part of a generator whose steps draw more noise than they start from, by `ancestral_noise`."""

    def draws_noise(self, nfe: int) -> bool:
        """Whether `sample` draws noise besides the initial one, which `evaluation.noise_scale` does not reach."""
        ...


@runtime_checkable
class HasStages(Protocol):
    """Optional part of a generator whose training has stages; `imfvla.generators.staged` has two."""

    def span(self, name: str, steps: int) -> tuple[float, float]:
        """The steps [first, end) of `steps` in which the parameter `name` of a policy learns."""
        ...

    def begin_step(self, core: nn.Module, step: int, steps: int) -> None:
        """Is told of step `step` (0-based) of `steps` before its loss, and with which step loaded weights end."""
        ...


def draws_noise(generator: Generator, nfe: int) -> bool:
    """`DrawsNoise.draws_noise`, false for a generator without it."""
    return isinstance(generator, DrawsNoise) and generator.draws_noise(nfe)


def uses_noise(generator: Generator) -> bool:
    """Whether a chunk depends on the noise: a generator for which it does not says `uses_noise = False`."""
    return getattr(generator, "uses_noise", True)


LAST_STEP = within(0.01, 0.99)  # a time between noise and data
TimeSampler = Callable[[int, Stream], Tensor]  # how many, from which stream -> (n,) in [0, 1]


class UniformTimes:
    """t ~ U[0, 1]."""

    def __call__(self, count: int, rng: Stream) -> Tensor:
        return draw(torch.rand, count, rng=rng)


class BetaTimes:
    """t = 1 - span (1 - B), B ~ Beta(alpha, 1), drawn as U^(1/alpha) (SmolVLA, arXiv 2506.01844: 1.5 and 0.999)."""

    def __init__(self, alpha: Annotated[float, above(0)], span: Annotated[float, within(0, 1)]) -> None:
        self.alpha, self.span = alpha, span

    def __call__(self, count: int, rng: Stream) -> Tensor:
        return 1 - self.span * (1 - draw(torch.rand, count, rng=rng) ** (1 / self.alpha))


class LogitNormalTimes:
    """t = sigmoid(mean + std n), n ~ N(0, 1) (arXiv 2505.13447)."""

    def __init__(self, mean: float, std: Annotated[float, at_least(0)]) -> None:
        self.mean, self.std = mean, std

    def __call__(self, count: int, rng: Stream) -> Tensor:
        return torch.sigmoid(self.mean + self.std * draw(torch.randn, count, rng=rng))


class HighNoiseTimes:
    """t = 1 - span U^power: most times near 1, where the noisy action does not give the answer away.

    At low noise a network can copy the action from its input and learns nothing from the pictures.
    """

    def __init__(
        self, span: Annotated[float, within(0, 1)] = 0.98, power: Annotated[float, above(0)] = 2.0
    ) -> None:
        self.span, self.power = span, power

    def __call__(self, count: int, rng: Stream) -> Tensor:
        return 1 - self.span * draw(torch.rand, count, rng=rng) ** self.power


def step_times(nfe: int, last_step: float | None = None) -> Tensor:
    """Times (nfe + 1,) from noise, 1, to data, 0: equal steps; with `last_step` the last of several starts there.

    Two steps then are one to the mean and one from little noise (arXiv 2512.01809 refines from 0.1).
    """
    if last_step is None:
        return torch.linspace(1, 0, nfe + 1)
    return torch.cat((torch.linspace(1, last_step, nfe), torch.zeros(1)))


def ancestral_noise(noise: Tensor, count: int) -> Tensor:
    """Noise (count, B, H, A) of the later steps, a pure function of the initial noise (B, H, A).

    Each row has its own generator, seeded with the BLAKE2b digest (8 bytes) of the row's float32 bytes, so that a chunk
    does not depend on the batch that it is sampled in. Without later steps nothing is drawn.
    """
    if not count:
        return noise.new_empty((0, *noise.shape))
    rows = []
    for row in noise.detach().to("cpu", torch.float32):
        digest = hashlib.blake2b(np.ascontiguousarray(row.numpy()).tobytes(), digest_size=8).digest()
        rng = torch.Generator().manual_seed(int.from_bytes(digest, "little"))
        rows.append(torch.randn(count, *row.shape, generator=rng))
    return torch.stack(rows, dim=1).to(noise)


def masked_mean(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of (B, H, A) over the valid steps and all channels: (B,)."""
    per_step = values.mean(-1)
    return (per_step * valid).sum(-1) / valid.sum(-1).clamp(min=1)


def masked_error(error: Tensor, valid: Tensor) -> Tensor:
    """Mean of squared errors (B, H, A) over the valid steps and all channels: (B,)."""
    return masked_mean(error.square(), valid)


def adapted(error: Tensor, power: float, offset: float) -> Tensor:
    """error / sg(error + offset) ** power: large errors count for less (arXiv 2505.13447)."""
    return error if power == 0 else error / (error.detach() + offset) ** power


def refuse_nfe(wanted: str, nfe: int) -> UserError:
    """The error of a generator that needs `wanted` calls of the core and was asked for `nfe`."""
    return UserError(f"nfe, the number of network steps, must be {wanted}, found {nfe}.")
