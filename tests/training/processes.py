"""Trainings in processes that torchrun starts, one after the other: torchrun ... processes.py JOBS.json."""

import json
import math
import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from safetensors.torch import load_file
from tiny_policy import OPTIM, OPTIONS, CountedBatches, TinyPolicy

from imfvla.nn.compiled import compile_parts
from imfvla.process.signals import Stopped
from imfvla.sources.mcap import McapSource
from imfvla.storage.run_directory import RunDirectory
from imfvla.training import compiling
from imfvla.training.logger import read_metrics
from imfvla.training.loop import Trainer
from imfvla.training.parallel import Alone, joined_processes


@dataclass(frozen=True)
class Job:
    """One training of the tiny policy, or of what `overrides` compose on the recordings in `demos`."""

    run: str
    options: dict[str, Any] = field(default_factory=dict)  # of the tiny policy's training that differ
    stops_before: int | None = None  # batch at which the last process is asked to stop
    nan_in: int | None = None  # batch with a row that is not finite
    overrides: list[str] | None = None
    demos: str = ""
    backend: str | None = None  # of compiled code


class FaultyBatches(CountedBatches):
    """The faults of a job."""

    def __init__(self, job: Job, is_last_process: bool) -> None:
        super().__init__()
        self.job, self.is_last_process = job, is_last_process

    def __next__(self) -> Any:
        number = self.next_batch
        if self.is_last_process and number == self.job.stops_before:
            os.kill(os.getpid(), signal.SIGTERM)  # one is asked, all stop after the same step
        return super().__next__()

    def batch(self, number: int) -> Any:
        batch = super().batch(number)
        if number == self.job.nan_in:
            batch.actions[5] = torch.nan
        return batch


class SharingPolicy(TinyPolicy):
    """Has to be given this process's rows alone."""

    def loss(self, batch: Any, rng: torch.Generator) -> Any:
        assert len(batch.actions) in (1, OPTIONS.batch_size // int(os.environ.get("WORLD_SIZE", 1)))
        return super().loss(batch, rng)


def make_trainer(job: Job, processes: Alone) -> Trainer:
    """As the job says; in a test, with `Alone()`, what several processes are compared with."""
    if job.overrides is None:
        is_last = processes.rank == processes.size - 1
        options = replace(OPTIONS, **{"steps": 6, "log_every": 1} | job.options)
        parts = SharingPolicy(), FaultyBatches(job, is_last), RunDirectory(job.run), options, OPTIM
    else:
        parts = composed_parts(job)
    return Trainer(*parts, seed=7, description={}, processes=processes)


def composed_parts(job: Job) -> tuple[Any, ...]:
    """The first arguments of a trainer, as the overrides of a job say."""
    from imfvla.command.composition import compose  # here: the tiny policy starts sooner without
    from imfvla.policy import build_policy
    from imfvla.training.data import make_loader, prepare_windows
    from imfvla.training.experiment import read_experiment

    config = compose("train", job.overrides)
    options = read_experiment(config)
    windows = prepare_windows(config, McapSource.of(job.demos))
    torch.manual_seed(0)
    return (
        build_policy(config, windows.statistics()),
        make_loader(options, windows),
        RunDirectory(job.run),
        options.training,
        options.optim,
    )


def train(job: Job, processes: Alone) -> int:
    """Trains until the end or until it is asked to stop; returns the step that it began from."""
    with patch.object(compiling, "compile_parts", partial(compile_parts, backend=job.backend)):
        trainer = make_trainer(job, processes)
    began = trainer.step
    with suppress(Stopped):
        trainer.train()
    return began


def torchrun(jobs: list[Job], file: Path, size: int = 2, restarts: int = 0) -> list[str]:
    """The command that trains `jobs`, which are written to `file`, in `size` processes each."""
    file.write_text(json.dumps([asdict(job) for job in jobs]))
    return [
        sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={size}",
        f"--max-restarts={restarts}", "--monitor-interval=0.1", __file__, str(file),
    ]  # fmt: skip


def launch(jobs: list[Job], file: Path, **options: int) -> None:
    """Trains `jobs`; fails with what was said where a process does."""
    command, environment = torchrun(jobs, file, **options), os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]


def assert_close(one: Path, other: Path, steps: int = 6) -> None:
    """The same losses, weights, averages and moments but for rounding."""
    tensors, expected = (load_file(run / "checkpoints/last/state.safetensors") for run in (one, other))
    assert tensors.keys() == expected.keys()
    for name, tensor in tensors.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-4, atol=1e-6)
    curves = [
        [row.get("loss", math.nan) for row in read_metrics(run / "metrics.jsonl")] for run in (one, other)
    ]
    assert curves[0] == pytest.approx(curves[1], rel=1e-5, nan_ok=True)  # of a step that was left out
    assert len(curves[0]) == steps


def train_all(jobs: list[Job]) -> None:
    """One after the other, by the processes that this one is of."""
    with joined_processes("cpu") as processes:
        for job in jobs:
            train(job, processes)


def gloo_threads() -> list[str]:
    """Those of this process; left at the interpreter's end, they now and then abort it."""
    names = [(task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()]
    return [name for name in names if "gloo" in name]


if __name__ == "__main__":
    train_all([Job(**job) for job in json.loads(Path(sys.argv[1]).read_text())])
    assert not (left := gloo_threads()), f"the process group outlives its training: {left}"
