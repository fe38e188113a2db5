"""Worker processes of an evaluation that die and hang."""

import os
import random
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from fakes import build_fakes

from faults.outcome import Differs, compare, rows_of
from faults.work import roll_out
from imfvla.config.protocol import EvaluationOptions
from imfvla.rollouts.evaluation import evaluate
from imfvla.storage.run_directory import RunDirectory


def die_or_hang_once(run: Path, step: int) -> tuple[Any, Any]:
    """A `workbench.Build` whose first process dies and whose second one hangs, in the middle of an episode."""
    env, policy = build_fakes(run, step)
    played, reset = [], env.reset

    def faulty(seed: int) -> Any:
        played.append(seed)
        for name, fault in (
            ("died", lambda: os.kill(os.getpid(), signal.SIGKILL)),
            ("hung", lambda: time.sleep(3600)),
        ):
            if len(played) == 3 and not (run / name).exists():
                (run / name).touch()
                fault()
        return reset(seed)

    env.reset = faulty
    return env, policy


def workers(folder: Path, kills: int, rng: random.Random) -> str:
    """Workers that die and hang: their episodes are played again, and the summary says how many did."""
    roll_out(folder / "whole", 8)
    roll_out(folder / "faulty", 8)
    (rollouts,) = (folder / "faulty" / "rollouts").iterdir()
    subprocess.run(["rm", "-rf", str(rollouts)], check=True)
    options = EvaluationOptions(episodes=8, first_seed=100_000, nfe=(1,), workers=1, episode_timeout_s=60.0)
    (summary,) = evaluate(RunDirectory(folder / "faulty"), options, build=die_or_hang_once)
    equal = compare(rows_of(folder / "faulty"), rows_of(folder / "whole"))
    if summary["worker_incidents"] != 2:
        raise Differs(f"worker_incidents is {summary['worker_incidents']}, wanted 2")
    return f"1 death, 1 hang: worker_incidents 2 in summary.json; {equal} parts equal bit for bit"
