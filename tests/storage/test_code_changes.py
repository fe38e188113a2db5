"""What counts as a change of a clone, and which changes are told apart."""

import errno
import os
import subprocess
from pathlib import Path

import pytest

from imfvla.storage import code_changes
from imfvla.storage.code_changes import changes_since_commit, commit_of


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    root = tmp_path / "clone"
    for name, text in ((".gitignore", "/runs/\n"), ("method.py", "one\n"), ("experiments/results/a", "1\n")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    identity = ["-c", "user.name=a", "-c", "user.email=a@localhost"]
    for arguments in (["init", "--quiet"], ["add", "."], [*identity, "commit", "--quiet", "-m", "begin"]):
        subprocess.run(["git", "-C", str(root), *arguments], check=True)
    return root


def test_a_clone_without_changes(clone):
    assert len(commit_of(clone)) == 40
    assert changes_since_commit(clone) == ""


def test_new_changed_and_deleted_files_count_and_are_told_apart(clone):
    found = []
    for name, text in (("new.py", "a"), ("new.py", "b"), ("other.py", "b"), ("method.py", "two\n")):
        (clone / name).write_text(text)
        found.append(changes_since_commit(clone))
    (clone / "new.py").chmod(0o755)
    found.append(changes_since_commit(clone))
    (clone / "method.py").unlink()
    found.append(changes_since_commit(clone))
    assert "" not in found
    assert len({*found}) == len(found)
    for name in ("new.py", "other.py"):
        (clone / name).unlink()
    (clone / "method.py").write_text("one\n")
    assert changes_since_commit(clone) == ""


def test_what_is_ignored_and_kept_results_do_not_count(clone):
    for name in ("runs/metrics.jsonl", "experiments/results/a", "experiments/results/b"):
        (clone / name).parent.mkdir(exist_ok=True)
        (clone / name).write_text("2\n")
    assert changes_since_commit(clone) == ""


def test_links_are_not_followed_and_names_are_as_the_disk_has_them(clone):
    (clone / "link").symlink_to("/dev/zero")
    (clone / os.fsdecode(b"caf\xe9 \n")).write_text("a")
    assert changes_since_commit(clone)


def test_large_files_count_by_size_and_time(clone, monkeypatch):
    monkeypatch.setattr(code_changes, "MAX_BYTES", 3)
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail("too large to read"))
    (clone / "new.bin").write_text("abcd")
    before = changes_since_commit(clone)
    os.utime(clone / "new.bin", ns=(0, 1))
    assert changes_since_commit(clone) != before


def test_without_git_nothing_is_known(tmp_path, monkeypatch):
    assert commit_of(tmp_path) is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert changes_since_commit(tmp_path) is None


def test_a_git_that_cannot_be_started_is_not_taken_for_other_code(clone, monkeypatch):
    def exhausted(*_, **__):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(subprocess, "Popen", exhausted)
    with pytest.raises(OSError, match="Too many open files"):
        commit_of(clone)
