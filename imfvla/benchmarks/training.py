"""Training samples per second, where the time of a step goes, and how much of the machine's peak it uses."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from imfvla.benchmarks.flops import training_flops
from imfvla.benchmarks.forcing import measure_saving
from imfvla.benchmarks.tables import PARTS_OF_A_STEP
from imfvla.policy import Policy
from imfvla.process.stopwatch import times_ms
from imfvla.sources.base import EpisodeSource
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.data import make_loader, prepare_windows
from imfvla.training.experiment import read_experiment
from imfvla.training.loop import Trainer
from imfvla.training.precision import autocast
from imfvla.types import Batch

GEMM = 2048  # rows and columns of the matrices that the peak is measured with


def measure_training(
    config: Mapping[str, Any], policy: Policy, demonstrations: EpisodeSource, scratch: Path, steps: int
) -> dict[str, Any]:
    """Trains `policy` for a few steps on demonstrations, as `imfvla.train` would, and times the parts.

    The parts are means over `steps` steps [ms]: waiting for data, encoder and conditioning, core and loss
    without the Jacobian-vector product, that product, backward, and clipping with optimiser and average
    of the weights.
    """
    read = read_experiment(config)
    options = replace(read.training, steps=steps, checkpoints=1)
    windows = prepare_windows(config, demonstrations)
    trainer = Trainer(
        policy,
        make_loader(read, windows),
        RunDirectory(scratch),
        options,
        read.optim,
        seed=0,
        description={},
    )
    num_threads, precision = torch.get_num_threads(), trainer.precision
    batches = make_loader(read, windows)
    try:
        batch = next(batches).to(trainer.device)
        flops = training_flops(policy, batch, precision)
        spent: dict[str, float] = defaultdict(float)
        for index in range(steps + 2):
            if index == 2:  # the first steps warm up
                spent.clear()
            _step(trainer, batches, spent)
        saving = measure_saving(trainer)
    finally:
        batches.close()
        trainer.batches.close()
    parts = {part: 1e3 * spent[part] / steps for part in PARTS_OF_A_STEP}
    step_ms = sum(parts.values())
    peak = peak_flops(precision, trainer.device)
    return {
        "samples_per_s": 1e3 * options.batch_size / step_ms,
        "step_ms": step_ms,
        **{f"{part}_ms": value for part, value in parts.items()},
        "batch_size": options.batch_size,
        "threads": num_threads,
        "precision": precision,
        "gflop_per_step": flops / 1e9,
        "achieved_gflops": flops / step_ms / 1e6,
        "peak_gflops": peak / 1e9,
        "share_of_peak": 1e3 * flops / step_ms / peak,
        **saving,
    }


def peak_flops(precision: str, device: torch.device) -> float:
    """Floating-point operations per second of a large matrix product, with the current number of threads."""
    a = torch.randn(GEMM, GEMM, device=device, dtype=torch.bfloat16 if precision == "bf16" else torch.float32)
    taken = times_ms([lambda: (a @ a)[0, 0].item()], calls=5)
    return 2 * GEMM**3 / (1e-3 * float(taken.min()))


def _step(trainer: Trainer, batches: Iterator[Batch], spent: dict[str, float]) -> None:
    """One step of training in its parts, adding the time of each [s] to `spent`."""
    policy = trainer.policy
    with _timed(spent, "data"):
        batch = next(batches).to(trainer.device)
    with autocast(trainer.precision, trainer.device):
        with _timed(spent, "encoder"):
            context = policy.core.condition(policy.encoder(batch.obs))
        with _timed(spent, "core"), _timed_derivative(policy.generator, spent):
            loss, _ = policy.generator.loss(
                policy.core,
                context,
                policy.targets(batch),
                batch.valid,
                torch.Generator().manual_seed(trainer.step),
            )
            loss = loss.mean()
    spent["core"] -= spent.pop("derivative", 0.0)
    with _timed(spent, "backward"):
        loss.backward()
    with _timed(spent, "optimiser"):
        gradients = [p.grad for p in policy.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        trainer.clipping.clip(gradients, norm, norm.isfinite())
        trainer.optimiser.step()
        trainer.optimiser.zero_grad(set_to_none=True)
        trainer.ema.update(trainer.step)
    trainer.step += 1


@contextmanager
def _timed(spent: dict[str, float], part: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    spent[part] += time.perf_counter() - began


@contextmanager
def _timed_derivative(generator: Any, spent: dict[str, float]) -> Iterator[None]:
    """Times what `generator.linearise` returns for derivatives separately, where the generator has it."""
    original = getattr(generator, "linearise", None)
    if original is None:
        yield
        return

    is_within = False

    def linearise(*args: Any) -> Any:
        u, push = original(*args)

        def timed(v: Any) -> Any:
            nonlocal is_within
            if is_within:  # under autocast a derivative asks for another one, in full precision
                return push(v)
            is_within = True
            with _timed(spent, "jvp"), _timed(spent, "derivative"):
                change = push(v)
            is_within = False
            return change

        return u, timed

    generator.linearise = linearise
    try:
        yield
    finally:
        del generator.linearise
