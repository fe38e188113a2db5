"""The `training` and `optim` groups of the config as checked values."""

from dataclasses import dataclass
from typing import Annotated

from imfvla.options import SHARE_BELOW_1, above, at_least, one_of, require, within

SHARDINGS = NONE, FULL = "none", "full"
# Far beyond useful values: anything larger is a typo and would fail late.
MAX_STEPS, MAX_BATCH, MAX_CHECKPOINTS, MAX_PREFETCH, MAX_THREADS = 10**9, 10**6, 10**4, 1024, 1024


@dataclass(frozen=True, slots=True)
class TrainingOptions:
    """How long and how a policy is trained. Raises UserError on values out of range."""

    steps: Annotated[int, within(1, MAX_STEPS)]
    batch_size: Annotated[int, within(1, MAX_BATCH)]
    log_every: Annotated[int, at_least(1)]  # steps between rows of metrics
    # Seconds between states to resume from; 0 saves after each step.
    save_every_s: Annotated[float, at_least(0)]
    # How many weights are kept, evenly spaced, the last ones at the end.
    checkpoints: Annotated[int, within(1, MAX_CHECKPOINTS)]
    # Parts of a batch, and of a process's share of it, whose gradients are added up one after the other.
    accumulate: Annotated[int, within(1, MAX_BATCH)]
    prefetch: Annotated[int, within(1, MAX_PREFETCH)]  # batches prepared ahead
    loader_threads: Annotated[int, within(1, MAX_THREADS)]  # that prepare them
    precision: Annotated[str, one_of("fp32", "tf32", "bf16", "auto")]
    compile: Annotated[bool | str, one_of(True, False, "auto")]
    device: Annotated[str, one_of("cpu", "cuda", "auto")]
    # Of OpenMP in a process; None for its share of the cores.
    threads: Annotated[int, within(1, MAX_THREADS)] | None
    sharding: Annotated[str, one_of(*SHARDINGS)]  # whether each of several processes holds the whole policy
    on_non_finite: Annotated[str, one_of("stop", "skip")]  # at a batch whose loss or gradient is not finite

    def __post_init__(self) -> None:
        wanted = f"at most {self.steps}, which is training.steps"
        require(self.checkpoints <= self.steps, "training.checkpoints", wanted, self.checkpoints)

    def checkpoint_steps(self) -> frozenset[int]:
        """Steps after which weights are kept: evenly spaced, the last step among them."""
        return frozenset(
            round(self.steps * part / self.checkpoints) for part in range(1, self.checkpoints + 1)
        )


@dataclass(frozen=True, slots=True)
class OptimOptions:
    """AdamW, its schedule, clipping, the average of the weights. Raises UserError on values out of range."""

    lr: Annotated[float, above(0)]
    betas: tuple[Annotated[float, SHARE_BELOW_1], Annotated[float, SHARE_BELOW_1]]
    eps: Annotated[float, above(0)]
    weight_decay: Annotated[float, at_least(0)]
    warmup: Annotated[float, within(0, 1)]  # share of the steps
    floor: Annotated[float, within(0, 1)]  # share of `lr` at the end
    # Gradients are clipped at this multiple of their running norm; at 1 or below, that norm would shrink.
    clip_factor: Annotated[float, above(1)] | None
    clip_norm: Annotated[float, above(0)] | None  # and at this norm
    ema_decay: Annotated[float, SHARE_BELOW_1]
