"""SIGKILL at random moments of one piece of work, every second time while a file is being written."""

import os
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from faults.outcome import Differs, compare
from imfvla.command import as_command

POLL_S = 0.001
Work = Callable[[Path], None]


def start(work: Work, folder: Path) -> int:
    """The process that does `work`; its output goes to `folder`.log."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        output = os.open(f"{folder}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        code = as_command(lambda: work(folder) and None)()
    except Exception as error:
        print(repr(error), file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def last_words(folder: Path) -> str:
    """The end of the output of a folder's processes."""
    return Path(f"{folder}.log").read_text(encoding="utf-8")[-500:]


def ended(child: int) -> int | None:
    """Its exit code, negative for a signal; None while it runs."""
    pid, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if pid else None


def half_written(folder: Path) -> set[tuple[str, int]]:
    """Files that are being written, or that a killed process was writing, with the times of their last change."""
    found = set()
    for path in files_of(folder):
        with suppress(FileNotFoundError):
            if {".tmp", ".part"} & {path.suffix, path.parent.suffix} or is_cut(path):
                found.add((path.name, path.stat().st_mtime_ns))
    return found


def is_cut(path: Path) -> bool:
    """Whether its last line is not whole."""
    text = content(path) if path.suffix == ".jsonl" else b""
    return bool(text) and not text.endswith(b"\n")


def progress_of(folder: Path) -> int:
    """Rows and recordings so far."""
    total = 0
    for path in files_of(folder):
        if path.suffix == ".mcap":
            total += path.parents[1] == folder
        elif path.name == "metrics.jsonl" or (path.suffix == ".jsonl" and path.parents[1].name == "rollouts"):
            total += content(path).count(b"\n")
    return total


def files_of(folder: Path) -> Iterator[Path]:
    """All files in a folder; some may vanish while it is read."""
    return (Path(place, name) for place, _, names in os.walk(folder) for name in names)


def content(path: Path) -> bytes:
    """Of a file; nothing if it has vanished."""
    with suppress(FileNotFoundError):
        return path.read_bytes()
    return b""


def kill_over(
    work: Work, folder: Path, kills: int, amount: int, rng: random.Random, *, spread_s: float = 0.02
) -> tuple[int, int]:
    """Restarts `work` until it ends by itself, killing it up to `kills` times over `amount` units of progress.

    A kill that waits for no write comes up to `spread_s` seconds after some progress. Returns the number of kills, and
    how many of them interrupted a write: a partial file was left.
    """
    done = during_write = 0
    while True:
        left_over = half_written(folder)  # by earlier kills
        child, began_at = start(work, folder), progress_of(folder)
        last = int(0.9 * amount)  # the last kill must not come after the end
        goal = began_at + rng.randint(0, max(0, 2 * (last - began_at) // max(1, kills - done) - 1))
        goal = min(goal, last)
        while (code := ended(child)) is None:
            if done < kills and progress_of(folder) >= goal:
                deadline = time.monotonic() + 2.0
                if done % 2:  # while a file is being written
                    while half_written(folder) <= left_over and ended_or_late(child, deadline):
                        pass
                else:
                    time.sleep(rng.random() * spread_s)
                with suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
                code = os.waitstatus_to_exitcode(status)
                break
            time.sleep(POLL_S)
        if code == -signal.SIGKILL:
            done += 1
            during_write += not half_written(folder) <= left_over
        elif code == 0:
            return done, during_write
        else:
            raise Differs(f"exit code {code}: {Path(f'{folder}.log').read_text(encoding='utf-8')[-500:]}")


def ended_or_late(child: int, deadline: float) -> bool:
    """Whether to keep waiting: the child runs and there is time left."""
    info = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    return info is None and time.monotonic() < deadline


def undisturbed(work: Work, folder: Path) -> None:
    """Runs the work once, in a process like those that are killed."""
    _, status = os.waitpid(start(work, folder), 0)
    if code := os.waitstatus_to_exitcode(status):
        raise Differs(
            f"the undisturbed run ended with {code}: {Path(f'{folder}.log').read_text(encoding='utf-8')[-500:]}"
        )


def kills_of(work: Work, leaves: Callable[[Path], dict[str, Any]], amount: int) -> Callable[..., str]:
    """A fault: SIGKILL during one piece of work."""

    def inject(folder: Path, kills: int, rng: random.Random) -> str:
        undisturbed(work, folder / "whole")
        done, during_write = kill_over(work, folder / "killed", kills, amount, rng)
        equal = compare(leaves(folder / "killed"), leaves(folder / "whole"))
        if done < kills:
            raise Differs(f"ended after {done} of {kills} kills")
        return f"{done} kills, {during_write} of them during a write; {equal} parts equal bit for bit"

    return inject
