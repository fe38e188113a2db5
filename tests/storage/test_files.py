import errno
import fcntl
import os
import threading
from pathlib import Path

import pytest

from imfvla.errors import UserError
from imfvla.rollouts.rollout_log import RolloutLog
from imfvla.storage.files import copy_file, locked, write_atomically, write_json, write_text, write_together
from imfvla.storage.run_directory import RunDirectory


def test_replaces_whole(tmp_path):
    path = tmp_path / "new" / "file.json"
    write_json(path, {"a": 1})
    write_json(path, {"a": 2})
    assert path.read_text() == '{\n  "a": 2\n}\n'
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


@pytest.mark.parametrize(
    ("number", "remedy"), [(errno.ENOSPC, "free some space"), (errno.EACCES, "is writable")]
)
def test_failed_write_names_file_and_remedy_and_keeps_the_old(tmp_path, number, remedy):
    path = tmp_path / "file"
    write_text(path, "old")

    def fail(temporary):
        temporary.write_text("ne")
        raise OSError(number, "the system's words")

    with pytest.raises(UserError, match=rf"Cannot write {path}: the system's words; .*{remedy}"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_interrupted_write_leaves_nothing(tmp_path):
    def interrupt(temporary):
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "file", interrupt)
    assert list(tmp_path.iterdir()) == []


def test_files_written_together_appear_together(tmp_path):
    one, two = tmp_path / "one", tmp_path / "new" / "two"
    write_together({one: b"1", two: b"2"})
    assert (one.read_bytes(), two.read_bytes()) == (b"1", b"2")
    in_the_way = tmp_path / "file" / "three"
    in_the_way.parent.write_text("no directory")
    with pytest.raises(UserError, match=f"Cannot write {in_the_way}"):
        write_together({one: b"changed", in_the_way: b"3"})
    assert one.read_bytes() == b"1"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "new", "one"]


def test_a_lock_is_waited_for_and_where_none_can_be_written_not(tmp_path):
    order = []

    def wait():
        with locked(tmp_path / "store"):
            order.append("second")

    other = threading.Thread(target=wait)
    with locked(tmp_path / "store"):
        other.start()
        other.join(timeout=0.1)
        order.append("first")
    other.join()
    assert order == ["first", "second"]
    with locked(Path("/proc/nothing/store")):
        order.append("third")
    assert order[-1] == "third"


def test_a_copy_is_made_where_it_differs(tmp_path):
    source, copy = tmp_path / "source.log", tmp_path / "media" / "copy.log"
    source.write_text("one")
    copy_file(source, copy)
    made = copy.stat().st_ino
    copy_file(source, copy)
    assert copy.stat().st_ino == made
    source.write_text("another")
    copy_file(source, copy)
    assert copy.read_text() == "another"


def test_only_a_lock_that_another_process_holds_is_one_that_is_held(tmp_path, monkeypatch, caplog):
    run = RunDirectory(tmp_path / "run")
    with run.lock(), pytest.raises(UserError, match=rf"is in use by process {os.getpid()}"):
        run.lock().__enter__()

    def not_here(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", not_here)
    with run.lock(), RolloutLog(tmp_path / "rollouts", {}), locked(tmp_path / "store"):
        pass
    for path in (run.path, tmp_path / "rollouts", tmp_path / "store"):
        assert (
            f"{path} cannot be locked (No locks available): let no other command write there" in caplog.text
        )
