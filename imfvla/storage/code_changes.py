"""What differs between a clone and its commit, new files included: a new method may be one file."""

import hashlib
import os
import stat
import subprocess
from pathlib import Path

from imfvla.process.running_time import run

TIMEOUT_S = 30  # of git
MAX_BYTES = 64 * 2**20  # read of all files together
# Kept results lie in the repository, but no result depends on them; a campaign adds to them while it runs.
NOT_CODE = ("experiments/results", "experiments/pretrained")


def commit_of(root: Path) -> str | None:
    """The commit of a clone, None where git or the clone is missing. Raises OSError as below."""
    found = _git(root, "rev-parse", "HEAD")
    return None if found is None else found.decode().strip() or None


def changes_since_commit(root: Path) -> str | None:
    """16 hex digits of the files that differ from the commit of a clone, "" where none does, None without git.

    Counts changed, deleted and new files that git does not ignore, by path, mode and content. Files beyond 64 MiB
    count by size and time of change. Raises OSError where git cannot be started, for lack of file handles for example.
    """
    excluded = (f":(exclude,top){folder}" for folder in NOT_CODE)
    listed = _git(
        root, "status", "--porcelain", "-z", "--no-renames", "--untracked-files=all", "--", ":/", *excluded
    )
    if listed is None:
        return None
    entries = sorted(entry[3:] for entry in listed.split(b"\0") if entry)
    if not entries:
        return ""
    digest, left = hashlib.sha256(), MAX_BYTES
    for name in entries:
        path = Path(root, os.fsdecode(name))
        content, read = _content(path, left)
        left -= read
        for part in (name, content):
            digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:16]


def _content(path: Path, limit: int) -> tuple[bytes, int]:
    """What stands for a file, never following a link, and how many bytes of it were read."""
    try:
        found = path.lstat()
        if stat.S_ISLNK(found.st_mode):
            return b"link " + os.fsencode(os.readlink(path)), 0
        if not stat.S_ISREG(found.st_mode):
            return b"no file", 0
        if found.st_size > limit:
            return b"large %d %d" % (found.st_size, found.st_mtime_ns), 0
        content = path.read_bytes()
    except FileNotFoundError:
        return b"deleted", 0
    except OSError as error:
        return b"unreadable %d" % (error.errno or 0), 0
    mode = b"file x " if found.st_mode & stat.S_IXUSR else b"file - "
    return mode + content, len(content)


def _git(root: Path, *arguments: str) -> bytes | None:
    """The output of git, which writes nothing; None where it is missing or fails."""
    command = ["git", "-C", str(root), *arguments]
    try:
        done = run(command, TIMEOUT_S, env=os.environ | {"GIT_OPTIONAL_LOCKS": "0"})
    except (FileNotFoundError, PermissionError, subprocess.TimeoutExpired):
        return None
    return None if done.returncode else done.stdout
