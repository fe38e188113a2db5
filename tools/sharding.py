"""Memory of each process that trains a policy of scale=paper, with the whole of it and with a part (FSDP2).

python tools/sharding.py                                        # two processes, two steps each way
python tools/sharding.py --processes 4 --batch 8 size.depth=18  # with overrides of conf/train.yaml

Trains on noise, on the CPU, each way in fresh processes. Prints, for the process that uses most: what it keeps between
steps (parameters, AdamW's moments, average of the weights), and its resident memory between steps, at its most within
a step and at its most while the state is saved (Linux), less what it took before there was a policy. Exits with 1
where losses differ by more than rounding.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import psutil
import torch
from torch import Tensor

from imfvla.command.composition import compose
from imfvla.data.statistics import Statistics
from imfvla.policy import build_policy
from imfvla.robot_of import robot_of
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.experiment import read_experiment
from imfvla.training.logger import read_metrics
from imfvla.training.loop import Trainer
from imfvla.training.options import SHARDINGS
from imfvla.training.parallel import joined_processes
from imfvla.training.train_state import save_state
from imfvla.types import MAX_WORDS, Batch, Observation

STEPS = 2
TOLERANCE = 1e-4  # of the loss
MIB = 2**20
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": "65536"}  # what is freed leaves the process


class Noise:
    """The same batch again and again; each one resets the peak of memory."""

    def __init__(self, config: dict[str, Any]) -> None:
        rng = torch.Generator().manual_seed(0)
        count, horizon = config["training"]["batch_size"], config["horizon"]
        robot, views = robot_of(config), config["observation"]["views"]
        pictures = (count, horizon["obs"], len(views), 3)
        observation = Observation(
            torch.randint(
                256, (*pictures, *config["observation"]["image_size"]), dtype=torch.uint8, generator=rng
            ),
            torch.rand(count, horizon["obs"], len(robot.state), generator=rng),
            torch.ones(count, MAX_WORDS, dtype=torch.int64),
        )
        actions = torch.rand(count, horizon["pred"], len(robot.action), generator=rng)
        self.origin = robot.origin
        self.batch = Batch(observation, actions, torch.ones(count, horizon["pred"], dtype=torch.bool))

    def __next__(self) -> Batch:
        forget_peak()
        return self.batch

    def statistics(self) -> Statistics:
        state, actions = self.batch.obs.state[:, -1].numpy(), self.batch.actions.numpy()
        displaced = actions - state[:, None, self.origin]
        return Statistics.of(state, actions[:, 0], displaced, self.batch.valid.numpy())

    def describe(self, number: int) -> list[str]:
        return [f"noise {row}" for row in range(len(self.batch.actions))]

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass

    def close(self) -> None:
        pass


def measure(overrides: list[str], run: str) -> None:
    """One process of a training: writes what it measured beside `run`."""
    config = compose("train", overrides)
    batches, options = Noise(config), read_experiment(config)
    with joined_processes("cpu") as processes:
        before = psutil.Process().memory_info().rss
        torch.manual_seed(0)
        trainer = Trainer(
            build_policy(config, batches.statistics()),
            batches,
            RunDirectory(run),
            options.training,
            options.optim,
            seed=0,
            description={},
            processes=processes,
        )
        trainer._save_state = trainer._save_weights = lambda *_: None  # is measured apart
        trainer.train()
        moments = (kept for state in trainer.optimiser.state.values() for kept in state.values())
        found = {
            "kept": of_this_process(
                [*trainer.policy.parameters(), *trainer.ema.policy.parameters(), *moments]
            ),
            "peak": peak() - before,
        }
        trainer.optimiser.zero_grad(set_to_none=True)
        found["between"] = psutil.Process().memory_info().rss - before
        forget_peak()
        save_state(trainer.run.last_state, trainer.state, {}, writes=processes.is_first)
        found["saving"] = peak() - before
        Path(f"{run}-{processes.rank}.json").write_text(json.dumps(found), encoding="utf-8")


def of_this_process(tensors: Iterable[Tensor]) -> int:
    """Bytes, of tensors in parts those of this process's part."""
    own = (tensor.to_local() if hasattr(tensor, "to_local") else tensor for tensor in tensors)
    return sum(tensor.numel() * tensor.element_size() for tensor in own)


def forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def peak() -> int:
    """The most resident memory since the peak was reset [bytes]."""
    (line,) = (
        line
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        if line.startswith("VmHWM")
    )
    return 1024 * int(line.split()[1])


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="of conf/train.yaml")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--batch", type=int, default=2, help="rows over all processes")
    parser.add_argument("--into", help=argparse.SUPPRESS)  # in the processes that this one starts
    options = parser.parse_args()
    if options.into:
        measure(options.overrides, options.into)
        return 0
    curves = []
    with tempfile.TemporaryDirectory(prefix="imfvla-sharding-") as folder:
        for sharding in SHARDINGS:
            run = f"{folder}/{sharding}"
            pace = [f"batch_size={options.batch}", f"steps={STEPS}", "checkpoints=1", "log_every=1"]
            pace += ["save_every_s=1e9", "precision=fp32", "threads=1", f"sharding={sharding}"]
            settings = ["scale=paper", *(f"training.{text}" for text in pace), *options.overrides]
            command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
            command += [f"--nproc-per-node={options.processes}", __file__, "--into", run, *settings]
            subprocess.run(command, env=os.environ | ENVIRONMENT, check=True)
            found = [
                json.loads(Path(f"{run}-{rank}.json").read_text(encoding="utf-8"))
                for rank in range(options.processes)
            ]
            most = {name: max(process[name] for process in found) / MIB for name in found[0]}
            curves.append([row["loss"] for row in read_metrics(Path(run) / "metrics.jsonl")])
            print(
                f"sharding={sharding}: {most['kept']:.0f} MiB of weights, moments and average; resident "
                f"{most['between']:.0f} MiB between steps, at most {most['peak']:.0f} MiB in a step, "
                f"{most['saving']:.0f} MiB while the state is saved; losses {curves[-1]}",
                flush=True,
            )
    different = max(abs(one / other - 1) for one, other in zip(*curves, strict=True))
    print(f"losses differ by {different:.1e}")
    return 1 if different > TOLERANCE else 0


if __name__ == "__main__":
    sys.exit(main())
