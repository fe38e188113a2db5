"""Eight Gaussians in the plane: what the configured generators make of many modes, without pictures and robots.

The modes lie on a circle of radius 2, deviation 0.1, all scaled to unit variance. A generator is judged by samples: its
energy distance to fresh data, the modes it reaches, and the share of samples within four deviations of a mode.

Shapes: B batch, N samples; a sample is a chunk of one step with two channels.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.command.composition import compose
from imfvla.config.construction import construct
from imfvla.generators.velocity import Pushes
from imfvla.nn.dual import LayerNorm, Same, SiLU, linear_map
from imfvla.nn.embeddings import TimeEmbedding
from imfvla.nn.linear import Linear
from imfvla.nn.transformer import copy_weights
from imfvla.training.ema import Ema

NUM_MODES, RADIUS, DEVIATION, SCALE = 8, 2.0, 0.1, 1 / math.sqrt(2)
SIGMAS = 4.0
LEAST_SHARE_OF_MODE = 0.5  # of the samples that are due to a mode, for it to count as reached
BATCH, RATE = 512, 2e-3
MAX_RAD = 1.0  # of the time embeddings


@dataclass(frozen=True, slots=True)
class Quality:
    """How samples compare with data."""

    energy_distance: float
    modes: int  # of 8 that were reached
    near: float  # share of samples within four deviations of a mode

    @property
    def passes(self) -> bool:
        return self.energy_distance < 0.01 and self.modes == NUM_MODES and self.near >= 0.85


def centres() -> Tensor:
    """(8, 2) of the modes."""
    angles = torch.arange(NUM_MODES) * (2 * math.pi / NUM_MODES)
    return SCALE * RADIUS * torch.stack((angles.cos(), angles.sin()), dim=-1)


def draw(count: int, rng: torch.Generator) -> Tensor:
    """Data (count, 2)."""
    modes = torch.randint(NUM_MODES, (count,), generator=rng)
    return centres()[modes] + SCALE * DEVIATION * torch.randn(count, 2, generator=rng)


def judge(samples: Tensor, rng: torch.Generator) -> Quality:
    """Samples (N, 2) against as many fresh data."""
    data = draw(len(samples), rng)
    distance, mode = torch.cdist(samples, centres()).min(dim=1)
    near = distance < SIGMAS * SCALE * DEVIATION
    counts = torch.bincount(mode[near], minlength=NUM_MODES)
    due = LEAST_SHARE_OF_MODE * len(samples) / NUM_MODES
    return Quality(energy_distance(samples, data), int((counts >= due).sum()), float(near.float().mean()))


def energy_distance(x: Tensor, y: Tensor) -> float:
    """2 E|x - y| - E|x - x'| - E|y - y'| of samples (N, 2), without bias (G. Szekely and M. Rizzo, 2013)."""

    def within(z: Tensor) -> Tensor:
        return torch.cdist(z, z).sum() / (len(z) * (len(z) - 1))

    return float(2 * torch.cdist(x, y).mean() - within(x) - within(y))


class PlaneCore(nn.Module):
    """A residual MLP (x, t, r) -> x, of the kind that flow generators drive; the context is not used.

    With `velocity_head` average and instantaneous velocity have layers each of their own, as in `TransformerCore`.
    """

    takes_duals = True

    def __init__(self, width: int, depth: int, *, velocity_head: bool = False) -> None:
        super().__init__()
        self.input = Linear(2, width)
        self.time = TimeEmbedding(width, MAX_RAD)
        self.interval = TimeEmbedding(width, MAX_RAD)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                LayerNorm(width, elementwise_affine=False),
                Linear(width, width),
                SiLU(),
                Linear(width, width),
            )
            for _ in range(depth)
        )
        self.norm = LayerNorm(width, elementwise_affine=False)
        self.output = Linear(width, 2)
        self.average: PlaneCore | None = copy.deepcopy(self) if velocity_head else None

    def forward(self, x: Same, t: Same, r: Same, context: Any) -> Same:
        """x (B, 1, 2), times (B,) -> (B, 1, 2)."""
        return (self.average or self).layers(x, t, r)

    def instant(self, x: Same, t: Same, context: Any) -> Same:
        """What the layers of the instantaneous velocity say, r = t."""
        return self.layers(x, t, t)

    def start_average(self) -> None:
        """The layers of the average velocity take the weights of those of the instantaneous one."""
        copy_weights(self, self.average)

    def layers(self, x: Same, t: Same, r: Same) -> Same:
        condition = self.time(t) + self.interval(t - r)
        hidden = self.input(x[:, 0]) + condition
        for block in self.blocks:
            hidden = hidden + block(hidden + condition)
        return linear_map(lambda x: x.unsqueeze(1), self.output(self.norm(hidden)))


class NoContext:
    """The context of a core that needs none."""

    def repeat(self, times: int) -> "NoContext":
        return self

    detach = rows = repeat


def shipped(name: str) -> Any:
    """The generator of conf/generator/<name>.yaml as it is."""
    return construct(compose("train", [f"generator={name}"])["generator"], "generator")


def flipped(generator: Any) -> Any:
    """The same with the sign of its derivative flipped: a mistake that the judgement must find."""
    linearise = generator.linearise

    def wrong(*arguments: Any) -> tuple[Tensor, Pushes]:
        u, push = linearise(*arguments)
        return u, lambda v: -push(v)

    generator.linearise = wrong
    return generator


GENERATORS: dict[str, Callable[[], Any]] = {
    "imf": lambda: shipped("imf"),
    "imf_plain": lambda: shipped("imf_plain"),
    "imf_plain, sign flipped": lambda: flipped(shipped("imf_plain")),
    "flow_high_noise": lambda: shipped("flow_high_noise"),
    "ddpm": lambda: shipped("ddpm"),
}
CASES = (  # generator, evaluations, whether it has to pass
    ("imf", 1, True),
    ("imf_plain", 1, True),
    ("flow_high_noise", 100, True),
    ("ddpm", 100, True),
    ("flow_high_noise", 1, False),
    ("imf_plain, sign flipped", 1, False),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A generator's samples in so many evaluations, and what they are worth."""

    generator: str
    nfe: int
    must_pass: bool
    samples: Tensor
    quality: Quality

    @property
    def is_as_expected(self) -> bool:
        return self.quality.passes == self.must_pass

    def row(self) -> dict[str, Any]:
        named = {"generator": self.generator, "nfe": self.nfe, "must_pass": self.must_pass}
        return {**named, **asdict(self.quality), "passes": self.quality.passes}


def train(
    generator: Any, *, steps: int, seed: int, width: int = 128, depth: int = 4, advance: Callable[[], None]
) -> nn.Module:
    """The averaged weights of a core that `generator` has trained; calls `advance` after each step."""
    torch.manual_seed(seed)
    staged = hasattr(generator, "span")
    core = PlaneCore(width, depth, velocity_head=generator.core_interface == "flow and v-head")
    learned = dict(core.named_parameters())
    spans = {name: generator.span(f"core.{name}", steps) if staged else (0, steps) for name in learned}
    ema = Ema(core, 0.999, spans)
    optimiser = torch.optim.Adam([{"params": [learned[name]], "span": span} for name, span in spans.items()])
    rng = torch.Generator().manual_seed(seed)
    valid = torch.ones(BATCH, 1, dtype=torch.bool)
    for step in range(steps):
        for group in optimiser.param_groups:
            first, end = group["span"]
            group["lr"] = RATE * (1 + math.cos(math.pi * (step - first) / (end - first))) / 2
        ema.settle(step)
        if staged:
            for learner in (core, ema.policy):
                generator.begin_step(learner, step, steps)
        loss, _ = generator.loss(core, NoContext(), draw(BATCH, rng).unsqueeze(1), valid, rng)
        optimiser.zero_grad()
        loss.mean().backward()
        nn.utils.clip_grad_norm_(core.parameters(), 1.0)
        optimiser.step()
        ema.update(step)
        advance()
    return ema.policy


@torch.no_grad()
def sample(generator: Any, core: nn.Module, count: int, nfe: int, seed: int) -> Tensor:
    """(count, 2) in `nfe` evaluations."""
    noise = torch.randn(count, 1, 2, generator=torch.Generator().manual_seed(seed + 1))
    return generator.sample(core, NoContext(), noise, nfe)[:, 0]


def run_cases(*, steps: int, samples: int, seed: int, advance: Callable[[], None]) -> list[Case]:
    """All cases, each generator trained once."""
    made = {name: build() for name, build in GENERATORS.items()}
    cores = {name: train(made[name], steps=steps, seed=seed, advance=advance) for name in made}
    found = []
    for name, nfe, must_pass in CASES:
        drawn = sample(made[name], cores[name], samples, nfe, seed)
        quality = judge(drawn, torch.Generator().manual_seed(seed + 2))
        found.append(Case(name, nfe, must_pass, drawn, quality))
    return found
