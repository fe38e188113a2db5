"""`imfvla.train` on recorded episodes and in a scene without simulator: python tests/tiny_sweep.py -m seed=0,1.

Every step of a training becomes a line of updates.log in the working directory; TINY_KILL_AT=N kills the process where
step N of them all would begin.
"""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from imfvla.command.completion import is_complete
from imfvla.command.entry import entry_point, output_directory
from imfvla.errors import UserError
from imfvla.storage.run_directory import RunDirectory

OVERRIDES = [
    "observation.image_size=[32,32]",
    "size.width=32",
    "size.heads=2",
    "size.depth=1",
    "training.batch_size=2",
    "training.steps=2",
    "training.checkpoints=1",
    "training.log_every=1",
    "training.save_every_s=0",
    "training.threads=1",
    "training.precision=fp32",
    "evaluation.nfe=[1]",
    "evaluation.episodes=2",
    "evaluation.workers=0",
]
UPDATES = Path("updates.log")
TIMES = ("latency", "fps")


def launch(arguments: list[str], directory: Path, **environment: str) -> subprocess.CompletedProcess:
    """This command in a process of its own, in `directory`."""
    tests = Path(__file__).resolve().parent
    paths = os.pathsep.join([str(tests), str(tests.parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"} | environment
    command = [sys.executable, __file__, *arguments]
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


@entry_point("train", is_complete)
def main(config: dict[str, Any]) -> None:
    from imfvla.command import experiment
    from imfvla.rollouts.evaluation import evaluate
    from imfvla.sources.mcap import McapSource

    if config["seed"] == 13:
        raise UserError("seed 13 is bad.")
    update = experiment.Trainer._update

    def noted(trainer: Any, batch: Any) -> dict[str, float]:
        lines = UPDATES.read_text().splitlines() if UPDATES.exists() else []
        if len(lines) + 1 == int(os.environ.get("TINY_KILL_AT", 0)):
            os.kill(os.getpid(), signal.SIGKILL)
        scalars = update(trainer, batch)
        with UPDATES.open("a") as file:
            file.write(f"{trainer.run.path.name} step {trainer.step}\n")
        return scalars

    with (
        mock.patch.object(
            experiment, "open_source", lambda config: McapSource.of(config["demos"]["directory"])
        ),
        mock.patch.object(
            experiment,
            "evaluate",
            lambda run, options: evaluate(run, replace(options, recordings=False), build=build),
        ),
        mock.patch.object(experiment, "check_demonstrations"),
        mock.patch.object(experiment.Trainer, "_update", noted),
    ):
        experiment.run_experiment(config, RunDirectory(output_directory()))


def build(run: Path, step: int) -> tuple[Any, Any]:
    """A `workbench.Build`: the trained policy in a scene whose stages depend on time and seed."""
    from fakes import FakeEnvironment

    from imfvla.tasks.bimanual_robot import bimanual_robot
    from imfvla.training.checkpoint import load_policy

    env = FakeEnvironment(robot=bimanual_robot(("front", "top", "r_wrist"), (32, 32)))
    return env, load_policy(RunDirectory(run), step)


def untimed_table(directory: Path) -> list[dict[str, str]]:
    """Our rows, which are in none of the paper's tables, without times."""
    from imfvla.reporting.answers import Sources
    from imfvla.reporting.results import Result
    from imfvla.reporting.tables import other_table

    table = other_table([Result(found) for found in Sources([directory / "runs"]).others([])]).data
    named = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    return [
        {key: value for key, value in row.items() if not any(name in key for name in TIMES)} for row in named
    ]


if __name__ == "__main__":
    main()
