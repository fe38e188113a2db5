"""The `training` and `optim` groups of the config as checked values."""

from dataclasses import dataclass

from imfvla.options import require
from imfvla.training.sharding import SHARDINGS


@dataclass(frozen=True, slots=True)
class TrainingOptions:
    """How long and how a policy is trained. Raises UserError on values out of range."""

    steps: int
    batch_size: int
    log_every: int  # steps between rows of metrics
    save_every_s: float  # seconds between states to resume from; 0 saves after each step
    checkpoints: int  # weights kept, evenly spaced, the last one at the end
    prefetch: int  # batches prepared ahead
    precision: str  # fp32 | bf16 | auto
    compile: bool
    device: str  # cpu | cuda | auto
    threads: int | None  # OpenMP threads of a process, None for its share of the physical cores
    sharding: str  # none | full: whether each of several processes holds all of the policy or its part
    on_non_finite: str  # stop | skip: at a batch whose loss or gradient is not finite

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoints", "prefetch"):
            require(getattr(self, name) >= 1, f"training.{name}", "at least 1", getattr(self, name))
        require(
            self.checkpoints <= self.steps, "training.checkpoints", f"at most {self.steps}", self.checkpoints
        )
        require(self.save_every_s >= 0, "training.save_every_s", "at least 0", self.save_every_s)
        precisions = ("fp32", "bf16", "auto")
        require(
            self.precision in precisions,
            "training.precision",
            "one of " + ", ".join(precisions),
            self.precision,
        )
        devices = ("cpu", "cuda", "auto")
        require(self.device in devices, "training.device", "one of " + ", ".join(devices), self.device)
        require(
            self.sharding in SHARDINGS,
            "training.sharding",
            "one of " + ", ".join(SHARDINGS),
            self.sharding,
        )
        require(
            self.on_non_finite in ("stop", "skip"),
            "training.on_non_finite",
            "stop or skip",
            self.on_non_finite,
        )
        require(
            self.threads is None or self.threads >= 1, "training.threads", "null or at least 1", self.threads
        )

    def checkpoint_steps(self) -> frozenset[int]:
        """Steps after which weights are kept: evenly spaced, the last step among them."""
        return frozenset(
            round(self.steps * part / self.checkpoints) for part in range(1, self.checkpoints + 1)
        )


@dataclass(frozen=True, slots=True)
class OptimOptions:
    """AdamW, its schedule, clipping, the average of the weights. Raises UserError on values out of range."""

    lr: float
    betas: tuple[float, float]
    eps: float
    weight_decay: float
    warmup: float  # share of the steps
    floor: float  # share of `lr` at the end
    clip_factor: float | None  # gradients are clipped at this multiple of their running norm
    clip_norm: float | None  # and at this norm, where it is given
    ema_decay: float

    def __post_init__(self) -> None:
        for name in ("lr", "eps"):
            require(getattr(self, name) > 0, f"optim.{name}", "above 0", getattr(self, name))
        # Below 1 the running mean would shrink, and every gradient with it.
        factor, norm = self.clip_factor, self.clip_norm
        require(factor is None or factor > 1, "optim.clip_factor", "null or above 1", factor)
        require(norm is None or norm > 0, "optim.clip_norm", "null or above 0", norm)
        require(self.weight_decay >= 0, "optim.weight_decay", "at least 0", self.weight_decay)
        require(all(0 <= beta < 1 for beta in self.betas), "optim.betas", "two numbers in [0, 1)", self.betas)
        for name in ("warmup", "floor"):
            require(0 <= getattr(self, name) <= 1, f"optim.{name}", "between 0 and 1", getattr(self, name))
        require(0 <= self.ema_decay < 1, "optim.ema_decay", "in [0, 1)", self.ema_decay)
