"""Files that are whole or absent: written beside their place, forced to disk, then renamed."""

import errno
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from imfvla.errors import UserError

log = logging.getLogger(__name__)
PARTIAL = ".tmp"  # suffix of what is being written; a leftover belongs to a killed process and may be deleted


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """`write(temporary)` fills a file beside `path`, which then takes its place in one step.

    After a kill or a failed write the old file is still there, whole. Raises UserError on a write error.
    """
    temporary = path.with_name(path.name + PARTIAL)
    with clear_write_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # A leftover of a killed process, or a link to somewhere else.
            temporary.unlink(missing_ok=True)
            write(temporary)
            sync(temporary)
            os.replace(temporary, path)
            sync(path.parent)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Atomic. Raises UserError on a write error."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8") and None)


def write_together(contents: Mapping[Path, bytes]) -> None:
    """All files or none: each is written beside its place, and they move there once all are written.

    Raises UserError on a write error; then the old files are still there.
    """
    temporaries = {path: path.with_name(path.name + PARTIAL) for path in contents}
    try:
        for path, content in contents.items():
            with clear_write_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                temporaries[path].write_bytes(content)
        for path, temporary in temporaries.items():
            with clear_write_errors(path):
                os.replace(temporary, path)
    finally:
        for temporary in temporaries.values():
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def copy_file(source: Path, path: Path) -> None:
    """Atomic; a copy of the same size and time is left as it is. Raises UserError on a write error."""
    original = source.stat()
    copy = path.stat() if path.exists() else None
    if copy is None or (copy.st_size, copy.st_mtime_ns) != (original.st_size, original.st_mtime_ns):
        write_atomically(path, lambda temporary: shutil.copy2(source, temporary) and None)


def write_json(path: Path, value: Any) -> None:
    """Atomic, indented, keys in their order. Raises UserError on a write error."""
    write_text(path, json.dumps(value, indent=2) + "\n")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Waits until no other process holds the lock of `path`, a hidden file beside it, and holds it.

    Where no lock file can be written, nothing else can be either, and there is nothing to wait for.
    """
    with ExitStack() as held:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = held.enter_context(open(path.with_name(f".{path.name}.lock"), "w", encoding="utf-8"))
            take_lock(stream.fileno(), path, wait=True)
        yield


def take_lock(descriptor: int, path: Path, *, wait: bool = False) -> bool:
    """Takes the lock of an open file; False where another process holds it, unless it waits.

    Some file systems, mainly network ones, have no locks. Then a warning names `path` and work starts without one.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        log.warning(
            "%s cannot be locked (%s): let no other command write there meanwhile.", path, error.strerror
        )
    return True


def sync(path: Path) -> None:
    """Forces a file's content, or a directory's entries, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def clear_write_errors(path: Path) -> Any:
    """Turns an OSError inside into a UserError that names the path and the remedy."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"Cannot write {path}: {reason}; {write_remedy(error)}.") from error


def write_remedy(error: OSError) -> str:
    """What the user can do about a failed write."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space there and rerun the same command; what was written before is intact"
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "no file handle is left: raise the limit (ulimit -n 4096) and rerun the same command"
    if error.errno == errno.EFBIG:
        return "raise the limit on the size of files (ulimit -f), or choose another directory"
    return "check that the directory exists and is writable, then rerun the same command"
