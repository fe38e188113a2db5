"""SIGKILL within the writing of a state, always: what is left beside the state, and whether it is deleted."""

import os
import random
import signal
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

from faults.killing import POLL_S, ended_or_late, half_written, start, undisturbed
from faults.outcome import Differs, compare, state_of
from faults.work import train
from imfvla.storage.run_directory import RunDirectory

MOST = 2  # a folder in which the library writes, and the file that was just moved out of it


def leftovers(folder: Path, kills: int, rng: random.Random) -> str:
    """Kills in the middle of saved states: never more than one write's files are left, and none at the end."""
    steps = 4 * kills
    work = partial(train, steps=steps)
    undisturbed(work, folder / "whole")
    killed, most, within = folder / "killed", 0, 0
    place = RunDirectory(killed).last_state.parent
    for _ in range(kills):
        child, before = start(work, killed), names_in(place)
        while names_in(place) <= before and ended_or_late(child, time.monotonic() + 60):
            pass
        time.sleep(rng.random() * POLL_S)
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        left = names_in(place)
        within += bool(left)
        most = max(most, len(left))
    if most > MOST:
        raise Differs(f"{most} files and folders were left beside the state")
    undisturbed(work, killed)
    if left := names_in(place) | {name for name, _ in half_written(killed)}:
        raise Differs(f"left behind: {left}")
    equal = compare(state_of(killed), state_of(folder / "whole"))
    return (
        f"{kills} kills, {within} of them left something, at most {most} names at a time, none at the end; "
        f"{equal} parts equal bit for bit"
    )


def names_in(place: Path) -> set[str]:
    """What lies beside a state."""
    with suppress(FileNotFoundError):
        return set(os.listdir(place)) - {"state.safetensors"}
    return set()
