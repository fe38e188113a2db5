"""Files that are whole or absent, after a kill and after a loss of power.

They are written beside their place, forced to disk, then renamed, and the new name is forced to disk too.
"""

import errno
import fcntl
import json
import logging
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from imfvla.errors import UserError
from imfvla.storage.opening import kind_of, open_to_append, open_to_read

log = logging.getLogger(__name__)
PARTIAL = ".tmp"  # suffix of what is being written; a leftover belongs to a killed process and may be deleted
SCRATCH = ".part"  # of a folder in which a library writes such a file
OLD, GONE = ".old", ".gone"  # of a folder that is being replaced, and of one that is being deleted
STALE_S = 3600.0  # age at which a temporary file that others may be writing is a leftover


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """`write(temporary)` fills a file beside `path`, which then takes its place in one step.

    After a kill, a failed write or a loss of power the old file is still there, whole. Raises UserError on a write
    error.
    """
    temporary = temporary_of(path)
    with clear_write_errors(path):
        try:
            make_folder(path.parent)
            write(temporary)
            put_file(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Atomic. Raises UserError on a write error."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8") and None)


def write_json(path: Path, value: Any) -> None:
    """Atomic, indented, keys in their order. Raises UserError on a write error."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_together(
    contents: Mapping[Path, bytes], copies: Mapping[Path, tuple[Path, Path]] | None = None
) -> None:
    """All files or none: each is written beside its place, and they move there once all are written.

    A kill while they move leaves some old files and some new ones, each whole. Commands that write into one folder
    wait for each other. `copies` are made first: copy -> (original, its home), see `copy_file`. Raises UserError on
    a write error; then the old files are still there.
    """
    temporaries = {path: temporary_of(path) for path in contents}
    folder = Path(os.path.commonpath([path.absolute().parent for path in contents]))
    with locked(folder / "published"):
        for path in (*contents, *(copies or {})):
            delete_leftovers(path, older_than_s=STALE_S)
        for copy, (original, home) in (copies or {}).items():
            copy_file(original, copy, home=home)
        try:
            for path, content in contents.items():
                with clear_write_errors(path):
                    make_folder(path.parent)
                    temporaries[path].write_bytes(content)
                    sync(temporaries[path])
            for path, temporary in temporaries.items():
                with clear_write_errors(path):
                    os.replace(temporary, path)
            for place in {path.parent for path in contents}:
                with clear_write_errors(place):
                    sync(place)
        finally:
            for temporary in temporaries.values():
                with suppress(OSError):
                    temporary.unlink(missing_ok=True)


def copy_file(source: Path, path: Path, *, home: Path | None = None) -> None:
    """Atomic; a copy of the same size and time is left as it is.

    `source` must lie in `home`, by default its own directory. Raises UserError on a write error, and where `source`
    is none that `storage.opening` opens.
    """
    with clear_write_errors(path), open_to_read(source, kind_of(source), home=home) as stream:
        original = os.fstat(stream.fileno())

        def write(temporary: Path) -> None:
            with open(temporary, "xb") as copy:
                shutil.copyfileobj(stream, copy)
            os.utime(temporary, ns=(original.st_atime_ns, original.st_mtime_ns))

        copy = path.stat() if path.exists() else None
        if copy is None or (copy.st_size, copy.st_mtime_ns) != (original.st_size, original.st_mtime_ns):
            write_atomically(path, write)


def refuse_existing(path: Path, remedy: str) -> None:
    """Raises UserError where something has that name, a link that leads nowhere included."""
    if os.path.lexists(path):
        raise UserError(f"{path} exists already: {remedy}.")


def put_file(temporary: Path, path: Path) -> None:
    """`temporary`, a file in the same folder, takes the place of `path`; both are on disk then. Raises OSError."""
    sync(temporary)
    os.replace(temporary, path)
    sync(path.parent)


def put_folder(part: Path, path: Path) -> None:
    """`part`, a folder beside `path`, takes its place; all that it holds is on disk then. Raises OSError.

    A folder at `path` moves aside and is deleted afterwards, since on NFS a file that a process has open cannot be
    deleted. After a kill in between call `clear_folder`. Others must not do the same at once.
    """
    clear_folder(path)
    for place, _, files in os.walk(part):
        for name in files:
            sync(Path(place, name))
        sync(Path(place))
    old = path.with_name(f".{path.name}{OLD}")
    with suppress(FileNotFoundError):
        os.rename(path, old)
    os.rename(part, path)
    sync(path.parent)
    clear_folder(path)


def clear_folder(path: Path) -> None:
    """Brings a folder back that a kill left aside while it was replaced, and deletes what replacements left."""
    old = path.with_name(f".{path.name}{OLD}")
    with suppress(FileNotFoundError, NotADirectoryError):
        gone = path if not os.path.lexists(path) else old.with_suffix(f".{secrets.token_hex(4)}{GONE}")
        os.rename(old, gone)
    for gone in _siblings(path, f".{path.name}.", GONE):
        with suppress(OSError):
            _delete(gone)


def make_folder(path: Path) -> None:
    """`mkdir -p`; the new names are on disk then. Raises OSError."""
    if path.is_dir():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync(path.parent)


def temporary_of(path: Path) -> Path:
    """A name beside `path` that nobody else writes to."""
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}{PARTIAL}")


def delete_leftovers(path: Path, *, older_than_s: float = 0.0) -> None:
    """Deletes what killed processes left of writing `path`. By default for a writer whose lock excludes others."""
    for leftover in _siblings(path, f"{path.name}.", PARTIAL, PARTIAL + SCRATCH):
        with suppress(OSError):
            if time.time() - leftover.lstat().st_mtime >= older_than_s:
                _delete(leftover)


def _siblings(path: Path, start: str, *ends: str) -> list[Path]:
    try:
        names = os.listdir(path.parent)
    except OSError:
        return []
    return [path.with_name(name) for name in names if name.startswith(start) and name.endswith(ends)]


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)  # NFS keeps what is open until it is closed
    else:
        path.unlink()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Waits until no other process holds the lock of `path`, a hidden file beside it while work goes on, and holds it.

    Where none can be made, a warning names `path` and work starts without one; on a read-only file system there is
    nothing to wait for. Raises UserError where something else has the lock's name.
    """
    lock = path.with_name(f".{path.name}.lock")
    with ExitStack() as held:
        try:
            make_folder(path.parent)
            while not _is_locked(held.enter_context(open_to_append(lock)), lock, path):
                held.close()  # its holder has deleted it meanwhile
        except OSError as error:
            if error.errno != errno.EROFS:
                _warn_unlocked(path, error)
        else:
            held.callback(_delete_lock, lock)
        yield


def _delete_lock(lock: Path) -> None:
    with suppress(OSError):
        lock.unlink()


def _is_locked(stream: IO[str], lock: Path, path: Path) -> bool:
    """Waits for the lock of an open file, and says whether that is still the file at `lock`."""
    if not take_lock(stream.fileno(), path):
        log.info("%s is in use by another command: waiting for it.", path.parent)
        take_lock(stream.fileno(), path, wait=True)
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(stream.fileno()), lock.stat())
    return False


def take_lock(descriptor: int, path: Path, *, wait: bool = False) -> bool:
    """Takes the lock of an open file; False where another process holds it, unless it waits.

    Some file systems, mainly network ones, have no locks. Then a warning names `path` and work starts without one.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        _warn_unlocked(path, error)
    return True


def _warn_unlocked(path: Path, error: OSError) -> None:
    log.warning("%s cannot be locked (%s): let no other command write there meanwhile.", path, error.strerror)


def sync(path: Path) -> None:
    """Forces a file's content, or a directory's entries, to disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that keeps no directories to be forced
            raise
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
