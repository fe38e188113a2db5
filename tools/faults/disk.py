"""A disk that is full or read-only, and a process that may open no more files."""

import errno
import os
import random
import resource
import signal
import subprocess
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

from faults.killing import POLL_S, Work, ended_or_late, half_written, progress_of, start, undisturbed
from faults.outcome import Differs, compare, state_of
from faults.work import train
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.tensor_files import read_tensors


def disk(folder: Path, kills: int, rng: random.Random) -> str:
    """A full disk, a read-only one, no file handles: a clear error, the last state intact, then training resumes."""
    work = partial(train, steps=200)
    undisturbed(work, folder / "whole")
    mounted = folder / "small"
    mounted.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(mounted)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        raise Differs("no right to mount a small file system: run this in a container as root")
    said = {}
    try:
        target = mounted / "run"
        child = start(work, target)
        while progress_of(target) < 8 and ended_or_late(child, time.monotonic() + 60):
            time.sleep(POLL_S)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with suppress(OSError), open(mounted / "filler", "wb") as filler:
            while True:
                filler.write(b"\0" * 4096)
                filler.flush()
        said["full disk"] = fails(work, target, errno.ENOSPC)
        (mounted / "filler").unlink()
        subprocess.run(["mount", "-o", "remount,ro", str(mounted)], check=True)
        said["read-only"] = fails(work, target, errno.EROFS)
        subprocess.run(["mount", "-o", "remount,rw", str(mounted)], check=True)
        said["file handles"] = fails(partial(without_handles, work), target, errno.EMFILE)
        undisturbed(work, target)
        equal = compare(state_of(target), state_of(folder / "whole"))
    finally:
        subprocess.run(["umount", str(mounted)], check=False)
    for what, words in said.items():
        print(f"    {what}: {words}")
    return f"{len(said)} faults, each with exit code 2; then {equal} parts equal bit for bit"


def without_handles(work: Work, folder: Path) -> None:
    """Leaves two handles: enough to open the logs, too few to save as well."""
    highest = max(map(int, os.listdir("/proc/self/fd")))
    while os.dup(0) <= highest:  # fills the gaps
        pass
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 4, highest + 4))
    work(folder)


def fails(work: Work, folder: Path, number: int) -> str:
    """The error that the user sees. Raises Differs if it is unclear, the state damaged or a partial file left."""
    log = folder.parent.parent / f"{errno.errorcode[number]}.log"  # on another file system
    link = Path(f"{folder}.log")
    with suppress(OSError):
        link.unlink(missing_ok=True)
        link.symlink_to(log)
    code = os.waitstatus_to_exitcode(os.waitpid(start_logging(work, folder, log), 0)[1])
    words = "".join(log.read_text(encoding="utf-8").strip().splitlines()[-1:]) if log.exists() else ""
    if code != 2 or os.strerror(number) not in words:
        raise Differs(f"wanted exit code 2 and {os.strerror(number)!r}, found {code}: {words!r}")
    read_tensors(RunDirectory(folder).last_state)
    if left := half_written(folder):
        raise Differs(f"left behind: {left}")
    return words


def start_logging(work: Work, folder: Path, log: Path) -> int:
    """As `start`, with the output in `log`."""

    def logged(_: Path) -> None:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.close(output)
        work(folder)

    return start(logged, log.with_suffix(""))
