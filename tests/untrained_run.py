"""A run directory of a small composed policy with random weights."""

from pathlib import Path

import numpy as np
import torch

from imfvla.command.composition import compose
from imfvla.data.statistics import Statistics
from imfvla.policy import build_policy
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import save_weights

STEPS = 5
SMALL = [
    "+exp=socket_ph32_exec16", "observation.image_size=[32,32]", "demos.episodes=2", "horizon.pred=8",
    "horizon.exec=4", "size.width=20", "core.depth=1", f"training.steps={STEPS}",
]  # fmt: skip


def untrained_run(path: Path, *overrides: str) -> RunDirectory:
    """The run at `path`, with weights of its last step."""
    run = RunDirectory(path)
    config = compose("train", [*SMALL, *overrides])
    run.claim(config)
    numbers = np.random.default_rng(0).normal(size=(50, 16)).astype(np.float32)
    chunks = np.repeat(numbers[:, None], 8, axis=1)
    torch.manual_seed(0)
    policy = build_policy(config, Statistics.of(numbers, numbers, chunks, np.ones((50, 8), bool)))
    save_weights(run.weights_directory(STEPS), policy, {"step": STEPS})
    return run
