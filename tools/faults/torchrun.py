"""SIGKILL of one of two processes that torchrun started: it restarts both, and they resume from the last state."""

import os
import random
import signal
import subprocess
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from socket import socket

import processes
import psutil

from faults.killing import POLL_S, progress_of, start
from faults.outcome import Differs, compare, state_of

STEPS = 60
HELD = {"whole": "none", "in parts": "full"}  # what each process holds of the policy: training.sharding
SPREAD_S = 0.05
TIMEOUT_S = 900.0  # for one start, on a machine that is busy with other work


def torchrun(folder: Path, kills: int, rng: random.Random) -> str:
    """Two trainings one after the other under one torchrun, the second one sharded."""
    kills = max(1, kills // 5)  # each is a start of Python and torch
    undisturbed_pair(folder / "undisturbed")
    during = killed_over(folder, kills, rng)
    equal = sum(
        compare(state_of(folder / "killed" / name), state_of(folder / "undisturbed" / name)) for name in HELD
    )
    words = ", ".join(f"{during.count(name)} with the policy {name} in each" for name in HELD)
    return f"{kills} kills, {words}; {equal} parts equal bit for bit"


def jobs_in(folder: Path) -> list[processes.Job]:
    """What is trained, into `folder`, which is made."""
    folder.mkdir()
    return [
        processes.Job(str(folder / name), {"steps": STEPS, "sharding": sharding})
        for name, sharding in HELD.items()
    ]


def undisturbed_pair(folder: Path) -> None:
    """The same in two processes that this one forks, which saves the start of Python."""
    jobs = jobs_in(folder)
    with socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]

    def train(log: Path, rank: int) -> None:
        os.environ |= {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "RANK": str(rank), "LOCAL_RANK": str(rank)}
        os.environ |= {"MASTER_ADDR": "localhost", "MASTER_PORT": str(port)}
        processes.train_all(jobs)

    pair = [start(partial(train, rank=rank), folder / f"process-{rank}") for rank in range(2)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in pair]
    for rank in range(2):
        check(max(map(abs, codes)), folder / f"process-{rank}.log")


def killed_over(folder: Path, kills: int, rng: random.Random) -> list[str]:
    """Kills at random moments until there have been `kills`, waits for the end, returns which training each hit."""
    log, during = folder / "killed.log", []
    command = processes.torchrun(jobs_in(folder / "killed"), folder / "jobs.json", restarts=kills)
    with started(command, log) as run:
        before: set[int] = set()
        for number in range(kills):
            began_at = progress_of(folder / "killed")
            last = int(0.9 * 2 * STEPS)
            goal = began_at + rng.randint(0, max(0, 2 * (last - began_at) // (kills - number) - 1))
            goal = min(goal, last)
            deadline = time.monotonic() + TIMEOUT_S
            while progress_of(folder / "killed") < goal or len(workers_of(run.pid) - before) < 2:
                if run.poll() is not None:
                    check(run.returncode, log)
                    raise Differs(f"ended after {number} of {kills} kills")
                if time.monotonic() > deadline:
                    raise Differs(f"no progress in {TIMEOUT_S:.0f} s after {number} kills: {tail(log)}")
                time.sleep(POLL_S)
            time.sleep(rng.random() * SPREAD_S)
            before = workers_of(run.pid)
            with suppress(ProcessLookupError):
                os.kill(rng.choice(sorted(before)), signal.SIGKILL)
            done = progress_of(folder / "killed")
            during.append(list(HELD)[done >= STEPS])
        check(run.wait(), log)
    return during


def started(command: list[str], log: Path) -> subprocess.Popen:
    """torchrun, with the output of all processes in `log`."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with open(log, "wb") as output:
        return subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)


def workers_of(pid: int) -> set[int]:
    """Living processes that torchrun has started."""
    children = psutil.Process(pid).children()
    return {child.pid for child in children if child.status() != psutil.STATUS_ZOMBIE}


def check(code: int, log: Path) -> None:
    if code:
        raise Differs(f"the processes ended with {code}: {tail(log)}")


def tail(log: Path) -> str:
    return log.read_text(encoding="utf-8", errors="replace")[-500:]
