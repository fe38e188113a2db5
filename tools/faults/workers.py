"""Worker processes of an evaluation that die, hang and are stopped for a while."""

import json
import os
import random
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import psutil
from fakes import build_fakes

from faults.killing import POLL_S, ended_or_late, last_words, progress_of, start
from faults.outcome import Differs, compare, rows_of
from faults.work import roll_out
from imfvla.config.protocol import EvaluationOptions
from imfvla.rollouts.evaluation import evaluate
from imfvla.storage.run_directory import RunDirectory

EPISODES = 6
LIMIT_S, STOPPED_S = 90.0, 100.0  # of an episode, where a worker also starts on a busy machine; of the stop


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


def frozen(folder: Path, kills: int, rng: random.Random) -> str:
    """An evaluation and its worker that are stopped for longer than an episode may take, as by Ctrl-Z."""
    roll_out(folder / "whole", EPISODES)
    roll_out(folder / "stopped", EPISODES)
    (rollouts,) = (folder / "stopped" / "rollouts").iterdir()
    subprocess.run(["rm", "-rf", str(rollouts)], check=True)

    def play(place: Path) -> None:
        options = EvaluationOptions(
            episodes=EPISODES, first_seed=100_000, nfe=(1,), workers=1, episode_timeout_s=LIMIT_S
        )
        evaluate(RunDirectory(place), options, build=build_slow_fakes)

    child = start(play, folder / "stopped")
    while progress_of(folder / "stopped") < 3 and ended_or_late(child, time.monotonic() + 600):
        time.sleep(POLL_S)
    group = [psutil.Process(child), *psutil.Process(child).children(recursive=True)]
    for process in group:
        process.suspend()
    time.sleep(STOPPED_S)
    for process in reversed(group):
        process.resume()
    if code := os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        raise Differs(f"exit code {code}: {last_words(folder / 'stopped')}")
    equal = compare(rows_of(folder / "stopped"), rows_of(folder / "whole"))
    summary = json.loads(next(folder.glob("stopped/rollouts/*/summary.json")).read_text(encoding="utf-8"))
    if summary["worker_incidents"]:
        raise Differs(f"a stop was taken for {summary['worker_incidents']} workers that hang")
    return f"stopped for {STOPPED_S:.0f} s where an episode may take {LIMIT_S:.0f} s: {equal} parts equal bit for bit"


def build_slow_fakes(run: Path, step: int) -> tuple[Any, Any]:
    """A `workbench.Build` whose episodes last long enough to be stopped in one."""
    env, policy = build_fakes(run, step)
    reset = env.reset

    def slow(seed: int) -> Any:
        time.sleep(1.0)
        return reset(seed)

    env.reset = slow
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
