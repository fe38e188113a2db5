"""A tiny policy and batches for the tests of the loop: no simulator, no pictures to speak of."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from imfvla.training.options import OptimOptions, TrainingOptions
from imfvla.types import Batch, Observation

STEPS, STATE, ACTION = 4, 3, 2

OPTIONS = TrainingOptions(
    steps=4,
    batch_size=8,
    log_every=3,
    save_every_s=0,
    checkpoints=2,
    accumulate=1,
    prefetch=1,
    loader_threads=1,
    precision="fp32",
    compile=False,
    device="cpu",
    threads=1,
    sharding="none",
    on_non_finite="stop",
)
OPTIM = OptimOptions(
    lr=1e-2,
    betas=(0.9, 0.95),
    eps=1e-8,
    weight_decay=1e-2,
    warmup=0.25,
    floor=0.1,
    clip_factor=1.1,
    clip_norm=None,
    ema_decay=0.9,
)


class TinyPolicy(nn.Module):
    """Regresses actions on the state, with dropout and noise so that random numbers matter."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Sequential(
            nn.Linear(STATE, 16), nn.ReLU(), nn.Dropout(0.2), nn.Linear(16, STEPS * ACTION)
        )
        self.query = nn.Parameter(torch.zeros(2, 16))  # never used: AdamW keeps nothing of it
        self.register_buffer("scale", torch.ones(ACTION))

    def spans(self, steps: int) -> dict[str, tuple[float, float]]:
        return {}

    def begin_step(self, step: int, steps: int) -> None:
        pass

    def loss(self, batch: Batch, rng: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        state = batch.obs.state[:, 0]
        state = state + 0.1 * torch.randn(state.shape, generator=rng)
        error = self.net(state).unflatten(-1, (STEPS, ACTION)) * self.scale - batch.actions
        mean = (error.square().mean(-1) * batch.valid).mean()
        return mean, {"error": error.detach().abs().mean()}


class CountedBatches:
    """Batch i is a function of i."""

    def __init__(self) -> None:
        self.next_batch = 0
        self.closed = False

    def __next__(self) -> Batch:
        batch = self.batch(self.next_batch)
        self.next_batch += 1
        return batch

    def batch(self, number: int) -> Batch:
        rng = np.random.default_rng(number)
        obs = Observation(
            images=torch.zeros(8, 1, 1, 3, 2, 2, dtype=torch.uint8),
            state=torch.from_numpy(rng.normal(size=(8, 1, STATE)).astype(np.float32)),
            instruction=torch.ones(8, 4, dtype=torch.int64),
        )
        actions = torch.from_numpy(rng.normal(size=(8, STEPS, ACTION)).astype(np.float32))
        return Batch(obs, actions, torch.ones(8, STEPS, dtype=torch.bool))

    def describe(self, number: int) -> list[str]:
        return [f"batch-{number}.mcap, step {row}" for row in range(8)]

    def state_dict(self) -> dict[str, Any]:
        return {"next_batch": self.next_batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.next_batch = state["next_batch"]

    def close(self) -> None:
        self.closed = True
