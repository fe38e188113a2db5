"""The one place that opens files of a directory from outside: a run, a policy, results, recordings, a data set.

A link that leads out of the directory, a pipe, a socket, a device, a directory in a file's place and a file above the
limit of its kind are refused before anything is read, and nothing here waits. A hard link looks like any other file
and is not recognised. Nobody else may change the directory meanwhile.
"""

import math
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from imfvla.errors import UserError

ANYWHERE = Path("/")  # as `home` of a file that the user names: its links may lead everywhere


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file, and how many bytes it may have."""

    name: str
    most: float


YAML = Kind("YAML file", 256 * 2**10)  # read a hundred times more slowly than JSON; a config has some 4 kB
JSON = Kind("JSON file", 64 * 2**20)
ROWS = Kind("file of rows", 64 * 2**20)
LOG = Kind("log", 256 * 2**20)
RECORDING = Kind("recording", 2 * 2**30)
VIDEO = Kind("video", 2 * 2**30)
WEIGHTS = Kind(
    "file of weights", 32 * 2**30
)  # pretrained ones; a policy says exactly how many bytes it needs
GRAPH = Kind("file of a graph", 2 * 2**30)  # more than ONNX can hold in one file
DATA = Kind("file of a data set", 256 * 2**30)  # read in parts
ARRAY = Kind("array", math.inf)  # mapped, not read
OF_SUFFIX = {
    ".yaml": YAML,
    ".json": JSON,
    ".jsonl": ROWS,
    ".log": LOG,
    ".mcap": RECORDING,
    ".mp4": VIDEO,
    ".safetensors": WEIGHTS,
}
SPECIAL = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a link that leads to itself",
}


def open_to_read(path: Path, kind: Kind, *, home: Path | None = None) -> IO[bytes]:
    """The file at `path`, which must lie in `home`, by default its own directory.

    Raises UserError where it is refused, OSError where it is missing or may not be read.
    """
    descriptor = _open(path, os.O_RDONLY, home)
    try:
        _refuse_large(path, os.fstat(descriptor).st_size, kind)
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def open_to_append(path: Path, *, home: Path | None = None) -> IO[str]:
    """The file at `path` for reading and for text at its end; made where it is missing.

    Raises UserError where it is refused, OSError where it cannot be written.
    """
    return open(_open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, home), "a+", encoding="utf-8")


def checked(path: Path, kind: Kind, *, home: Path | None = None) -> Path:
    """Where `path` leads, for a library that opens files by their names itself. Raises as `open_to_read`."""
    with open_to_read(path, kind, home=home):
        return real_path(path, home)


def kind_of(path: Path) -> Kind:
    """The kind that the end of a name says. Raises UserError for another one."""
    if path.suffix not in OF_SUFFIX:
        raise UserError(f"{path} must end in one of {', '.join(OF_SUFFIX)}: rename it.")
    return OF_SUFFIX[path.suffix]


def real_path(path: Path, home: Path | None = None) -> Path:
    """Where links lead from `path`. Raises UserError where that is outside of `home`, by default its directory."""
    home = path.parent if home is None else home
    real = Path(os.path.realpath(path))
    if not real.is_relative_to(os.path.realpath(home)):
        raise UserError(
            f"{path} links out of {home}, to {real}: remove that link, or put the file itself there."
        )
    return real


def refuse_strangers(home: Path) -> None:
    """Raises UserError where something in `home` would redirect or block writes: see this module."""
    for place, folders, files in walk(home):
        for path in (Path(place, name) for name in (*folders, *files)):
            real_path(path, home)
            if not os.path.isdir(path) and os.path.exists(path):
                _refuse_special(path, os.stat(path).st_mode)


def walk(home: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """`os.walk`. Raises UserError where folders are nested too deeply for it."""
    try:
        yield from os.walk(home)
    except RecursionError:
        raise UserError(f"{home} has folders that are nested hundreds of levels deep: remove them.") from None


def _open(path: Path, flags: int, home: Path | None) -> int:
    real = real_path(path, home)
    # Before the file is opened: opening a device can have effects.
    try:
        _refuse_special(path, os.lstat(real).st_mode)
    except FileNotFoundError:
        if not flags & os.O_CREAT:
            raise
    descriptor = os.open(real, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        _refuse_special(path, os.fstat(descriptor).st_mode)
        os.set_blocking(descriptor, True)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _refuse_special(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        found = SPECIAL.get(stat.S_IFMT(mode), "something else")
        raise UserError(
            f"Wanted a file, found {found} at {path}: remove what has that name, or choose another directory."
        )


def _refuse_large(path: Path, size: int, kind: Kind) -> None:
    if size > kind.most:
        raise UserError(
            f"{path} has {size} bytes, wanted at most {kind.most:.0f} of a {kind.name}: restore it."
        )


def size_of(stream: IO[Any]) -> int:
    """Bytes of an open file."""
    return os.fstat(stream.fileno()).st_size
