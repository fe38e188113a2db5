"""Signals that ask a training to stop."""

import json
import os
import random
import signal
import time
from functools import partial
from pathlib import Path

from faults.killing import POLL_S, ended_or_late, progress_of, start, undisturbed
from faults.outcome import Differs, compare, state_of
from faults.work import train
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import read_metrics
from imfvla.training.tensor_files import read_tensors


def stops(folder: Path, kills: int, rng: random.Random) -> str:
    """Signals that ask to stop: the state of the step is saved, the exit code names the signal."""
    work = partial(train, steps=120)
    rarely = partial(train, steps=120, save_every_s=1e9)
    undisturbed(work, folder / "whole")
    slowest, codes = 0.0, set()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    for turn in range(max(3, kills // 5)):
        child = start(rarely, folder / "stopped")
        goal = progress_of(folder / "stopped") + rng.randint(1, 5)
        while progress_of(folder / "stopped") < goal and ended_or_late(child, time.monotonic() + 60):
            time.sleep(POLL_S)
        rows = len(read_metrics(folder / "stopped" / "metrics.jsonl"))
        began, number = time.monotonic(), numbers[turn % 3]
        os.kill(child, number)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        slowest = max(slowest, time.monotonic() - began)
        codes.add(code)
        if code != 128 + number:
            raise Differs(f"after {number.name} exit code {code}")
        _, header = read_tensors(RunDirectory(folder / "stopped").last_state)
        if json.loads(header["details"])["step"] < rows:
            raise Differs("steps before the stop were lost")
    undisturbed(work, folder / "stopped")
    equal = compare(state_of(folder / "stopped"), state_of(folder / "whole"))
    return f"{turn + 1} stops, exit codes {sorted(codes)}, at most {slowest:.1f} s; {equal} parts equal bit for bit"
