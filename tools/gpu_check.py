"""What a GPU does with the paper's sizes: steps/s, the time of a chunk, and whether it computes what a CPU does.

tools/gpu_check.sh                                  # under 8 minutes
tools/gpu_check.sh --device cpu --quick             # the same on a CPU, with small networks and few calls

- training: steps/s of the headline policy, with the plain form and both stages of the other, in each precision, and in
  bf16 with the loss compiled as one graph; and the peak of the GPU's memory. Batches are random and come from the host.
- latency: median and 95th percentile of a chunk at batch 1, numpy to numpy, for the policies of Table 3's rows.
- equality: losses of the same few training steps on the device and on the CPU, in fp32 with the same random numbers.
- derivative: error of Mean Flow's Jacobian-vector product in fp32 and TF32 against float64, of a shipped policy.

Writes `gpu_check.json` and `gpu_check.md`; exits with 1 where losses differ by more than the tolerance.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from imfvla.benchmarks.latency import LOG_MEDIAN
from imfvla.benchmarks.rounding import derivative_errors
from imfvla.benchmarks.tables import SAME_STEP, SPEEDS, speed_ratios, speed_table
from imfvla.command.composition import compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.data.statistics import Statistics
from imfvla.policy import Policy, build_policy
from imfvla.process.progress import Progress
from imfvla.process.stopwatch import times_ms
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.statistics.bootstrap import bootstrap
from imfvla.reporting.table import Table, number
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.threads import threads
from imfvla.storage.files import write_json, write_text
from imfvla.storage.fingerprint import fingerprint
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy
from imfvla.training.experiment import read_experiment
from imfvla.training.loop import Trainer, choose_device
from imfvla.training.precision import PRECISIONS, TF32
from imfvla.types import MAX_WORDS, Batch, Observation

HEADLINE = "socket_ph32_exec16"
STAGES = {"imf_plain": 0.0, "imf, first stage": 0.0, "imf, second stage": 0.9}  # and where in a training
SHIPPED = Path("experiments/pretrained/socket_ph32_exec16/generator=imf_plain")
TOLERANCE = 1e-3  # of a loss, relative, over the steps that are compared
MIB = 2**20


@dataclass(frozen=True, slots=True)
class Effort:
    """How much is measured."""

    scale: str
    batch: int
    steps: int
    calls: int  # of a chunk with one step; n steps have an n-th of them
    compared_steps: int
    rows: int  # observations of the derivative
    overrides: tuple[str, ...] = ()
    experiments: int | None = None


FULL = Effort(scale="paper", batch=64, steps=20, calls=200, compared_steps=5, rows=32)
QUICK = Effort(
    scale="cpu",
    batch=4,
    steps=1,
    calls=3,
    compared_steps=2,
    rows=2,
    overrides=("core.depth=1",),
    experiments=1,
)


class RandomBatches:
    """Endless batches from the host, all of one content."""

    def __init__(self, policy: Policy, rows: int) -> None:
        rng, (height, width) = np.random.default_rng(0), policy.image_size
        pixels = rng.integers(
            0, 256, (rows, policy.horizon.obs, len(policy.views), 3, height, width), np.uint8
        )
        state = rng.uniform(-1, 1, (rows, policy.horizon.obs, len(policy.robot.state))).astype(np.float32)
        words = np.ones((rows, MAX_WORDS), np.int64)
        actions = rng.uniform(-1, 1, (rows, *policy.noise_shape)).astype(np.float32)
        valid = torch.ones(rows, policy.horizon.pred, dtype=torch.bool)
        seen = Observation(*map(torch.from_numpy, (pixels, state, words)))
        self.batch = Batch(seen, torch.from_numpy(actions), valid)

    def __next__(self) -> Batch:
        return self.batch

    def close(self) -> None:
        pass


class BlankWorld:
    """What an actor asks of an environment before a chunk, without a simulator."""

    name, instruction = "blank", "put the peg into the socket"

    def __init__(self, policy: Policy) -> None:
        self.robot = policy.robot


def composed(effort: Effort, *overrides: str) -> dict[str, Any]:
    return compose("train", [f"scale={effort.scale}", *overrides, *effort.overrides])


def fitted(config: Mapping[str, Any]) -> Policy:
    """A policy with random weights whose normalisers are of random numbers."""
    torch.manual_seed(0)
    batch = RandomBatches(build_unfitted(config), 16).batch
    states, actions = batch.obs.state[:, -1].numpy(), batch.actions.numpy()
    return build_policy(
        config,
        Statistics.of(
            states, actions[:, 0], actions - states[:, None, : actions.shape[2]], batch.valid.numpy()
        ),
    )


def trainer_of(
    config: Mapping[str, Any],
    batch: int,
    device: torch.device,
    precision: str,
    scratch: str,
    compile: bool = False,
) -> Trainer:
    read, policy = read_experiment(config), fitted(config)
    options = replace(
        read.training, device=device.type, precision=precision, batch_size=batch, compile=compile
    )
    batches = RandomBatches(policy, batch)
    return Trainer(policy, batches, RunDirectory(scratch), options, read.optim, seed=0, description={})


def measure_training(effort: Effort, device: torch.device) -> dict[str, dict[str, float]]:
    """Steps/s and MiB by form and precision."""
    found = {}
    on_gpu = device.type == "cuda"
    arms = [(one, False) for one in PRECISIONS if one != TF32 or on_gpu] + [("bf16", True)] * on_gpu
    with Progress("training", len(STAGES) * len(arms)) as bar, tempfile.TemporaryDirectory() as scratch:
        for form, begins in STAGES.items():
            config = composed(effort, f"+exp={HEADLINE}", f"generator={form.split(',')[0]}")
            for precision, compiled in arms:
                arm = f"{form}, {precision}{', compiled' * compiled}"
                trainer = trainer_of(
                    config, effort.batch, device, precision, f"{scratch}/{arm}", compile=compiled
                )
                trainer.policy.train()
                trainer.step = int(begins * trainer.options.steps)
                if on_gpu:
                    torch.cuda.reset_peak_memory_stats()
                run_steps(trainer, 1 + effort.steps // 5)
                began = time.perf_counter()
                run_steps(trainer, effort.steps)
                seconds = time.perf_counter() - began
                memory = torch.cuda.max_memory_allocated() / MIB if on_gpu else 0.0
                found[arm] = {
                    "steps_per_s": effort.steps / seconds,
                    "step_ms": 1e3 * seconds / effort.steps,
                    "peak_mib": memory,
                }
                bar.advance(arm)
    return found


def run_steps(trainer: Trainer, steps: int) -> None:
    for _ in range(steps):
        trainer._update(next(trainer.batches))
    losses = [scalars["loss"] for _, scalars in trainer.unread.read()]  # waits for the device
    assert all(map(math.isfinite, losses)), losses


def measure_latency(effort: Effort, device: torch.device) -> dict[str, dict[str, dict[str, float]]]:
    """Times of a chunk [ms] by experiment and sampler, of every comparison of speed in Table 3."""
    rows = [
        row
        for comparison in read_mapping().comparisons
        if comparison.paper and comparison.of in SPEEDS
        for row in (comparison.baseline, comparison.row)
        if set(row.overrides) <= SAME_STEP
    ]
    wanted: dict[str, set[int]] = {}
    for row in rows:
        wanted.setdefault(row.experiment, set()).add(row.nfe)
    names = list(wanted)[: effort.experiments]
    found: dict[str, dict[str, dict[str, float]]] = {}
    with Progress("latency", len(names)) as bar, threads(1):
        for name in names:
            policy = fitted(composed(effort, f"+exp={name}")).to(device).eval()
            policy.begin_step(1, 1)  # of two stages, samples are those of the end
            for nfe in sorted(wanted[name]):
                times = chunk_times(policy, nfe, max(2, effort.calls // nfe), device)
                found.setdefault(name, {})[f"infer{nfe}"] = {
                    "median_ms": float(np.median(times)),
                    "p95_ms": float(np.percentile(times, 95)),
                    "log_error": bootstrap(LOG_MEDIAN, times).error or 0.0,
                }
            bar.advance(name)
    return found


def chunk_times(policy: Policy, nfe: int, calls: int, device: torch.device) -> np.ndarray:
    actor, batch = ChunkActor(policy, policy.horizon, nfe, 0, device), RandomBatches(policy, 1).batch
    actor.reset(BlankWorld(policy), 0)
    pictures = batch.obs.images[0].permute(0, 1, 3, 4, 2).contiguous().numpy()
    states = batch.obs.state[0].numpy()
    (times,) = times_ms([lambda: actor.plan(list(pictures), list(states), 0)], calls)
    return times


def compare_losses(effort: Effort, device: torch.device) -> dict[str, list[float]]:
    """Losses of training steps with the same random numbers, on the device and on the CPU."""
    config = compose("train", [f"+exp={HEADLINE}", "generator=imf_plain", *effort.overrides])
    found = {}
    for name, place in (("cpu", torch.device("cpu")), ("device", device)):
        with tempfile.TemporaryDirectory() as scratch:
            trainer = trainer_of(config, 8, place, "fp32", scratch)
            trainer.policy.train()
            found[name] = []
            for step in range(effort.compared_steps):
                batch, rng = (
                    trainer.transfer.receive(next(trainer.batches)),
                    torch.Generator().manual_seed(step),
                )
                loss, _ = trainer.policy.loss(batch, rng)  # draws on the CPU, wherever the policy is
                trainer.optimiser.zero_grad(set_to_none=True)
                loss.backward()
                for group in trainer.optimiser.param_groups:
                    group["lr"] = 1e-4
                trainer.optimiser.step()
                found[name].append(loss.item())
    return found


def measure_derivative(effort: Effort, device: torch.device) -> dict[str, dict[str, float]]:
    run = RunDirectory(SHIPPED)
    policy = load_policy(run, run.weights_step()).to(device).eval()
    return derivative_errors(policy, RandomBatches(policy, effort.rows).batch.obs)


def tables_of(found: Mapping[str, Any], effort: Effort) -> list[Table]:
    training = tuple(
        (form, number(row["steps_per_s"], 2), number(row["step_ms"], 1), number(row["peak_mib"], 0))
        for form, row in found["training"].items()
    )
    latency = tuple(
        (name, sampler, number(row["median_ms"], 2), number(row["p95_ms"], 2))
        for name, samplers in found["latency"].items()
        for sampler, row in samplers.items()
    )
    losses = tuple(
        (str(step), f"{ours:.6f}", f"{theirs:.6f}", f"{abs(ours / theirs - 1):.1e}")
        for step, (ours, theirs) in enumerate(
            zip(found["losses"]["device"], found["losses"]["cpu"], strict=True), 1
        )
    )
    errors = tuple(
        (precision, *(f"{row[key]:.1e}" for key in ("u", "derivative", "compound")))
        for precision, row in found["derivative"].items()
    )
    title = f"Training of {HEADLINE} at scale={effort.scale}, batch {effort.batch}"
    return [
        Table(title, ("form, precision", "steps/s", "ms a step", "MiB at most"), training),
        Table("A chunk at batch 1, numpy to numpy [ms]", ("experiment", "sampler", "median", "p95"), latency),
        *([speed_table(found["ratios"])] if found["ratios"] else []),
        Table(f"Losses, limit {TOLERANCE}", ("step", "device", "cpu", "difference"), losses),
        Table("Relative errors against float64", ("precision", "u", "du/dt", "u + (t - r) du/dt"), errors),
    ]


@as_command
def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="small networks and few calls")
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu_check"))
    options = parser.parse_args(arguments)
    device, effort = choose_device(options.device), QUICK if options.quick else FULL
    began = time.perf_counter()
    parts: dict[str, Callable[[Effort, torch.device], Any]] = {
        "derivative": measure_derivative,
        "losses": compare_losses,
        "latency": measure_latency,
        "training": measure_training,
    }
    found: dict[str, Any] = {part: measure(effort, device) for part, measure in parts.items()}
    found["ratios"] = speed_ratios(read_mapping().comparisons, found["latency"])
    worst = max(
        abs(ours / theirs - 1)
        for ours, theirs in zip(found["losses"]["device"], found["losses"]["cpu"], strict=True)
    )
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    found |= {"device": name, "quick": options.quick, "worst_loss_difference": worst}
    found |= {"seconds": round(time.perf_counter() - began, 1), "fingerprint": fingerprint(device=name)}
    tables = tables_of(found, effort)
    options.output.mkdir(parents=True, exist_ok=True)
    write_json(options.output / "gpu_check.json", found)
    text = "\n".join(table.markdown() for table in tables)
    write_text(options.output / "gpu_check.md", f"# {name}\n\n{text}")
    for table in tables:
        table.print()
    print(json.dumps({"seconds": found["seconds"], "worst_loss_difference": worst}))
    return 0 if worst <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
