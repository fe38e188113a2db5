"""A disk that keeps, when the power goes, only what was forced to it: what a crash at any moment leaves."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHANGES = ("fsync", "replace", "rename", "unlink", "rmdir", "mkdir")
Inode = tuple[int, int]


class LosingDisk:
    """Watches the folder `root`; `images` are folders as crashes would leave it, below `crashes`.

    At each moment there are two: one with only the names that were forced to disk, and one with all names of that
    moment, since a disk may have kept more than it was asked to. A file has what was forced of its content in both.
    """

    def __init__(self, root: Path, crashes: Path) -> None:
        self.root, self.crashes = root, crashes
        self.images: list[Path] = []
        self._contents: dict[Inode, bytes] = {}
        self._names: dict[Inode, dict[str, Inode]] = {}
        self._held: list[int] = []  # open, so that no number of an inode is used again
        self.is_busy = False
        for place, _, files in os.walk(root):  # what was there before is on disk
            for path in (Path(place), *(Path(place, name) for name in files)):
                self.force(os.open(path, os.O_RDONLY))

    def force(self, descriptor: int) -> None:
        """Puts what an open file or directory holds now on disk."""
        self._held.append(descriptor)
        here = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        if here.is_dir():
            self._names[_inode(here)] = {name: _inode(here / name) for name in os.listdir(here)}
        else:
            self._contents[_inode(descriptor)] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def made(self, folder: Path) -> None:
        """A new directory has no names on disk."""
        self._held.append(os.open(folder, os.O_RDONLY))
        self._names[_inode(folder)] = {}

    def crash(self) -> None:
        """Adds what a crash at this moment would leave."""
        for names in (self._forced, self._all):
            image = self.crashes / f"{len(self.images):04d}"
            self._leave(self.root, _inode(self.root), image, names)
            self.images.append(image)

    def close(self) -> None:
        for descriptor in self._held:
            os.close(descriptor)

    def _forced(self, _: Path, inode: Inode) -> dict[str, Inode]:
        return self._names[inode]

    def _all(self, place: Path, _: Inode) -> dict[str, Inode]:
        return {name: _inode(place / name) for name in os.listdir(place)}

    def _leave(
        self, place: Path, inode: Inode, image: Path, names: Callable[[Path, Inode], dict[str, Inode]]
    ) -> None:
        image.mkdir()
        for name, inner in names(place, inode).items():
            if inner in self._names:
                self._leave(place / name, inner, image / name, names)
            else:
                (image / name).write_bytes(self._contents.get(inner, b""))


def _inode(path: Path | int) -> Inode:
    status = os.fstat(path) if isinstance(path, int) else os.lstat(path)
    return status.st_dev, status.st_ino


@contextmanager
def watch(root: Path, crashes: Path) -> Iterator[LosingDisk]:
    """Watches writes into `root`: crashes after each change of a name and each forcing, and at the end."""
    crashes.mkdir()
    disk = LosingDisk(root, crashes)

    def watched(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def change(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            if not disk.is_busy:
                disk.is_busy = True
                if name == "fsync":
                    disk.force(os.dup(args[0]))
                if name == "mkdir":
                    disk.made(Path(args[0]))
                disk.crash()
                disk.is_busy = False
            return result

        return change

    with pytest.MonkeyPatch.context() as patch:
        for name in CHANGES:
            patch.setattr(os, name, watched(name, getattr(os, name)))
        yield disk
    disk.crash()
    disk.close()
