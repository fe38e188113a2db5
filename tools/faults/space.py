"""A small disk that is full again and again while it grows: every command stops clearly and goes on with more room."""

import os
import random
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from synthetic import write_demonstrations

from faults.killing import Work, files_of, half_written, start, undisturbed
from faults.outcome import Differs, compare, demonstrations_of, rows_of, state_of
from faults.work import collect, roll_out, train
from imfvla.data import FrameStore
from imfvla.sources.conversion import convert
from imfvla.sources.mcap import McapSource
from imfvla.storage.files import write_together

Leaves = Callable[[Path], dict[str, Any]]
ENDS_WITH = "free some space there"


def space(folder: Path, kills: int, rng: random.Random) -> str:
    """Each kind of work on a disk that has too little room `kills` times, less and less too little."""
    demos = write_demonstrations(folder / "demos", num_episodes=4, num_steps=12)
    size = max(4, kills)
    works: dict[str, tuple[Work, Leaves]] = {
        "training": (partial(train, steps=size), state_of),
        "collection": (partial(collect, episodes=size), demonstrations_of),
        "evaluation": (partial(roll_out, episodes=size), rows_of),
        "frame store": (partial(decode, demos), files_in),
        "conversion to mcap": (partial(convert_to, "mcap", demos), files_in),
        "conversion to lerobot": (partial(convert_to, "lerobot", demos), names_in),
        "publication": (publish, files_in),
    }
    full = equal = 0
    for name, (work, leaves) in works.items():
        whole = folder / "whole" / name
        whole.parent.mkdir(exist_ok=True)
        undisturbed(work, whole)
        needed = sum(path.stat().st_size for path in files_of(whole))
        place = folder / "small" / name
        with small_disk(place) as resize:
            for part in sorted(rng.random() for _ in range(kills)):
                resize(int(part * needed))
                full += is_full(work, place / "work", folder / f"{name}.log")
            resize(16 * needed + 2**20)
            undisturbed(work, place / "work")
            equal += compare(leaves(place / "work"), leaves(whole))
    if full < len(works) * kills / 2:
        raise Differs(f"the disk was full only {full} times")
    return f"{full} times full in {len(works)} kinds of work; {equal} parts equal bit for bit"


@contextmanager
def small_disk(place: Path) -> Iterator[Callable[[int], None]]:
    """Mounts a file system in memory at `place`; yields what gives it so many bytes."""
    place.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        raise Differs("no right to mount a small file system: run this in a container as root")

    def resize(size: int) -> None:
        option = f"remount,size={max(8, size // 1024)}k"
        subprocess.run(["mount", "-o", option, str(place)], check=False, capture_output=True)

    try:
        yield resize
    finally:
        subprocess.run(["umount", str(place)], check=False)


def is_full(work: Work, place: Path, log: Path) -> bool:
    """Whether the work met a full disk. Raises Differs where its error is unclear or a partial file is left."""
    log.unlink(missing_ok=True)
    child = start(lambda _: work(place), log.with_suffix(""))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == 0:
        return False
    lines = log.read_text(encoding="utf-8").strip().splitlines()
    said = [line for line in lines if ENDS_WITH in line or "disk space" in line]
    if code != 2 or len(lines) != 1 or said != lines or str(place) not in lines[0]:
        raise Differs(f"{log.stem}: wanted exit code 2 and one line, found {code}: {lines}")
    if left := half_written(place):
        raise Differs(f"{log.stem}: left behind: {left}")
    return True


def decode(demos: Path, folder: Path) -> None:
    FrameStore.build(McapSource.of(demos), folder / "store", (16, 16), ("front", "top"))


def convert_to(target: str, demos: Path, folder: Path) -> None:
    if not (folder / "converted").exists():  # else it says so
        options = {"format": target, "path": str(folder / "converted")}
        pictures = {"pictures": "h264"} if target == "lerobot" else {}
        convert({"source": "mcap", "path": str(demos)}, options | pictures)


def publish(folder: Path) -> None:
    write_together({folder / f"{number}.md": bytes([number]) * 5000 for number in range(6)})


def files_in(folder: Path) -> dict[str, Any]:
    """Names and contents of all files."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in files_of(folder)}


def names_in(folder: Path) -> dict[str, Any]:
    """Names and sizes of all files, whose content may say when they were written."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in files_of(folder)}
