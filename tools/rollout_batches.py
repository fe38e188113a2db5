"""Processor time of an episode where a worker plays several side by side, over that of one alone.

python tools/rollout_batches.py experiments/pretrained/socket_ph32_exec16/default --nfe 1
python tools/rollout_batches.py runs/socket_ddpm_ph32_exec16/default --nfe 10 100 --steps 160

Batches are measured in turn, in one process with one thread, after one that warms up.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from imfvla.config.protocol import SELECTION_FIRST_SEED, Protocol
from imfvla.reporting.table import Table, number
from imfvla.rollouts.workbench import Job, load_workbench, roll_out
from imfvla.storage.run_directory import RunDirectory


def episode_s(job: Job, batch: int, episodes: int) -> float:
    """Processor time of an episode [s]; at least `episodes` are played, in whole batches."""
    job = replace(job, protocol=replace(job.protocol, batch=batch))
    first, batches, began = job.protocol.first_seed, math.ceil(episodes / batch), time.process_time()
    for place in range(first, first + batches * batch, batch):
        roll_out(job, range(place, place + batch))
    return (time.process_time() - began) / (batches * batch)


@as_command
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="directory of a trained run")
    parser.add_argument("--nfe", type=int, nargs="+", default=[1])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--episodes", type=int, default=1, help="at least, of each batch and round")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--steps", type=int, help="control steps of an episode; all where not said")
    options = parser.parse_args(arguments)
    run = RunDirectory(options.run)
    step, task = run.weights_step(), run.config()["task"]
    rows = []
    for nfe in options.nfe:
        protocol = Protocol(
            task["name"], task.get("variant", "default"), step, run.weights_digest(), nfe, 0, 1.0,
            SELECTION_FIRST_SEED, 1, options.steps, "cpu",
        )  # fmt: skip
        job = Job(load_workbench, options.run, protocol)
        brief = replace(job, protocol=replace(protocol, max_steps=1))
        for batch in options.batches:
            episode_s(brief, batch, 1)  # builds the environments
        times = np.array(
            [
                [episode_s(job, batch, options.episodes) for batch in options.batches]
                for _ in range(options.rounds)
            ]
        )
        medians = np.median(times, axis=0)
        rows += [
            (str(nfe), str(batch), number(taken, 2), number(taken / medians[0], 2))
            for batch, taken in zip(options.batches, medians, strict=True)
        ]
    steps = "whole episodes" if options.steps is None else f"{options.steps} control steps"
    note = f"{steps}; medians of {options.rounds} round(s); over the first batch of a sampler."
    Table("Processor time of an episode [s]", ("NFE", "batch", "s", "ratio"), tuple(rows), (note,)).print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
