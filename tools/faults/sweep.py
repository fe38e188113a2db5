"""SIGKILL during a whole sweep: composing, training, evaluating and writing rows, from one job to the next."""

import os
import random
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tiny_sweep
from synthetic import write_demonstrations

from faults.killing import kill_over, undisturbed
from faults.outcome import Differs, compare, rows_of, state_of
from imfvla.storage.run_directory import DONE, RunDirectory


@dataclass(frozen=True)
class Size:
    """How much work there is, so that kills find some."""

    seeds: int
    steps: int
    episodes: int

    @classmethod
    def of(cls, kills: int) -> "Size":
        return cls(max(1, kills // 16), max(4, 2 * kills // 5), max(2, kills // 6))

    @property
    def jobs(self) -> int:
        return 2 * self.seeds

    def run(self, folder: Path) -> None:
        """The command of the tests, in `folder`, where its recordings are."""
        os.chdir(folder)
        sizes = [f"training.steps={self.steps}", f"evaluation.episodes={self.episodes}"]
        seeds = ",".join(map(str, range(self.seeds)))
        jobs = ["-m", f"seed={seeds}", "core=attnres,standard", "demos.directory=demonstrations"]
        tiny_sweep.main([*jobs, *tiny_sweep.OVERRIDES, *sizes, "training.checkpoints=2"])


def runs_of(folder: Path) -> dict[str, Any]:
    """Everything that the jobs leave, except times, and their rows of the table."""
    found: dict[str, Any] = {"table": tiny_sweep.untimed_table(folder)}
    for path in sorted((folder / "runs").glob("*/*")):
        run = RunDirectory(path)
        if (state := run.status().get("state")) != DONE:
            raise Differs(f"{path.name} is {state}")
        parts = state_of(path) | rows_of(path) | {"config": run.config()}
        found |= {f"{path.name} {name}": part for name, part in parts.items()}
    return found


def sweep(folder: Path, kills: int, rng: random.Random) -> str:
    """Killed and restarted to its end; work that no kill interrupted is not repeated."""
    size = Size.of(kills)
    whole, killed = folder / "whole", folder / "killed"
    for place in (whole, killed):
        write_demonstrations(place / "demonstrations")
    undisturbed(size.run, whole)
    amount = size.jobs * (size.steps + size.episodes)
    done, during_write = kill_over(size.run, killed, kills, amount, rng, spread_s=0.5)
    equal = compare(runs_of(killed), runs_of(whole))
    if done < kills:
        raise Differs(f"ended after {done} of {kills} kills")
    times = Counter((killed / tiny_sweep.UPDATES).read_text(encoding="utf-8").splitlines())
    repeated = sum(times.values()) - len(times)
    steps = size.jobs * size.steps
    if len(times) != steps or repeated > kills:
        raise Differs(f"{len(times)} steps of {steps} were taken, {repeated} more than once")
    return (
        f"{done} kills, {during_write} of them during a write; {repeated} of {steps} steps were repeated; "
        f"{equal} parts of {size.jobs} runs equal bit for bit"
    )
