"""The one error type that users see, and the conversion of system errors into it."""

import errno
import os
from pathlib import Path


class UserError(ValueError):
    """A mistake that the user can correct. Commands print its text alone and exit with status 2.

    The text is one sentence or two: the key or file, what was wanted, what was found, the remedy.
    """


_SPACE = "free some space there"
_PERMISSION = "check who may read and write there, or choose another directory"
_IN_THE_WAY = "remove what has that name, or choose another directory"
_DEVICE = "check that disk or network"
# What the user can do about a system error. A missing file is not listed: only its reader knows what it means.
REMEDIES = {
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EROFS: "choose a directory that may be written to",
    errno.EACCES: _PERMISSION,
    errno.EPERM: _PERMISSION,
    errno.EEXIST: _IN_THE_WAY,
    errno.ENOTDIR: _IN_THE_WAY,
    errno.EISDIR: _IN_THE_WAY,
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EIO: _DEVICE,
    errno.ESTALE: _DEVICE,
    errno.EMFILE: "no file handle is left; raise the limit with ulimit -n 4096",
    errno.ENFILE: "no file handle is left; stop other programs",
    errno.ENOMEM: "memory has run out; choose fewer workers=... or a smaller batch",
}
WHERE_MISSING = {errno.ENOENT: "check that its parent directories exist"}


def as_user_error(error: BaseException, remedies: dict[int, str] = REMEDIES) -> UserError | None:
    """A UserError, or one for a system error, which either raised or caused this error; None for other errors."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, UserError):
            return cause
        if isinstance(cause, OSError) and isinstance(cause.__context__, UserError) and not cause.filename:
            return cause.__context__  # closing the file met the same error again, without the file's name
        if isinstance(cause, OSError) and cause.errno in remedies:
            file = f" at {os.fsdecode(cause.filename)}" if isinstance(cause.filename, str | bytes) else ""
            return UserError(f"{cause.strerror}{file}: {remedies[cause.errno]}; rerun the same command.")
        if isinstance(cause, MemoryError):
            return UserError(
                f"Out of memory: {cause or 'no details'}; choose fewer workers=... or a smaller batch."
            )
        cause = cause.__cause__
    return None


def unreadable(path: Path, error: PermissionError) -> UserError:
    """The error of a file that may not be read. It may be intact, so that it is not called damaged."""
    return UserError(f"{path} cannot be read: {error.strerror or error}; check its permissions.")
