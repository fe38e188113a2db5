"""Several commands in one place: publications at once, a file system without locks, and NFS that keeps open files."""

import errno
import fcntl
import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
from synthetic import write_demonstrations

from faults.killing import last_words, start, undisturbed
from faults.outcome import Differs, compare, rows_of, state_of
from faults.work import roll_out, train
from imfvla.data import FrameStore
from imfvla.sources.mcap import McapSource
from imfvla.storage.files import write_together
from imfvla.storage.run_directory import RunDirectory

FILES, WRITERS = 8, 4


def publications(folder: Path, kills: int, rng: random.Random) -> str:
    """Commands that publish into one folder at once: all succeed, and all files are of one of them."""
    page = folder / "page"

    def publish(number: int, _: Path) -> None:
        for _ in range(5):
            write_together({page / f"{name}": bytes([number]) * 4096 for name in range(FILES)})

    turns = max(1, kills // 5)
    for turn in range(turns):
        logs = [folder / f"{turn}-{number}" for number in range(WRITERS)]
        children = [start(partial(publish, number), logs[number]) for number in range(WRITERS)]
        codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        if any(codes):
            raise Differs(f"exit codes {codes}: {[last_words(log) for log in logs]}")
        names = sorted(path.name for path in page.iterdir())
        if names != sorted(map(str, range(FILES))):
            raise Differs(f"left behind: {sorted(set(names) - set(map(str, range(FILES))))}")
        contents = {path.read_bytes() for path in page.iterdir()}
        if len(contents) != 1:
            raise Differs(f"files of {len(contents)} publications are mixed")
    return f"{turns * WRITERS * 5} publications, {WRITERS} at a time: none failed, none were mixed"


def no_locks(folder: Path, kills: int, rng: random.Random) -> str:
    """A file system without locks: each command says so once for each place, and does its work."""

    def locked_training(place: Path) -> None:
        with RunDirectory(place).lock():
            train(place, steps=20)

    def publication(place: Path) -> None:
        write_together({place / "page" / "index.html": b"a page"})

    works = {
        "training": locked_training,
        "evaluation": partial(roll_out, episodes=4),
        "publication": publication,
    }
    for name, work in works.items():
        undisturbed(work, folder / "whole" / name if (folder / "whole").is_dir() else made(folder, name))
        undisturbed(partial(without_locks, work), folder / name)
        if "cannot be locked (No locks available)" not in last_words(folder / name):
            raise Differs(f"{name} did not say that there are no locks: {last_words(folder / name)!r}")
    equal = compare(state_of(folder / "training"), state_of(folder / "whole" / "training"))
    equal += compare(rows_of(folder / "evaluation"), rows_of(folder / "whole" / "evaluation"))
    return f"{len(works)} commands said so; {equal} parts equal bit for bit"


def made(folder: Path, name: str) -> Path:
    (folder / "whole").mkdir()
    return folder / "whole" / name


def without_locks(work: partial, place: Path) -> None:
    """Does the work where no lock can be taken."""

    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    fcntl.flock = none
    work(place)


def nfs(folder: Path, kills: int, rng: random.Random) -> str:
    """Frame stores replaced while a process has them open, where open files cannot be deleted, as on NFS."""
    numbers, original = count(), os.unlink

    def keep(path: str | Path, *, dir_fd: int | None = None) -> None:
        """NFS renames a file that is open instead of deleting it: here all that `shutil.rmtree` deletes."""
        kept = f".nfs{next(numbers):024d}"
        if dir_fd is None:
            original(path)
        elif not str(path).startswith(".nfs"):
            os.rename(path, kept, src_dir_fd=dir_fd, dst_dir_fd=dir_fd)

    @contextmanager
    def keeping() -> Iterator[None]:
        os.unlink = keep
        try:
            yield
        finally:
            os.unlink = original

    return stores_replaced(folder, max(2, kills // 5), keeping)


def stores_replaced(folder: Path, turns: int, keeping: Callable[[], AbstractContextManager[None]]) -> str:
    """Replaces a store that is in use, each time within `keeping`, which keeps open files that are deleted."""
    source = McapSource.of(write_demonstrations(folder / "demos", num_episodes=2, num_steps=6))
    store = folder / "store"
    for turn in range(turns):
        old = FrameStore.build(source, store, (8 + turn, 8), ("front",))
        pixels = old.images.copy()
        (store / f".nfs{turn:024x}").write_bytes(b"of another process")
        with keeping():
            new = FrameStore.build(source, store, (9 + turn, 8), ("front",))
        if not np.array_equal(old.images, pixels):
            raise Differs("the pictures of a store in use have changed")
        if new.image_size != (9 + turn, 8) or FrameStore.open(store).image_size != new.image_size:
            raise Differs(f"a store of {new.image_size} was opened")
        del old, new
    FrameStore.build(source, store, (8, 8), ("front",))  # by now nothing is open
    left = [path.name for path in folder.iterdir() if path.name not in ("demos", "store")]
    if left:
        raise Differs(f"left behind: {left}")
    shutil.rmtree(store)
    return f"{turns} stores replaced while in use: the old pictures stayed readable, nothing was left"
