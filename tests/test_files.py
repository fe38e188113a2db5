import errno

import pytest

from imfvla.errors import UserError
from imfvla.files import write_atomically, write_json, write_text


def test_replaces_whole(tmp_path):
    path = tmp_path / "new" / "file.json"
    write_json(path, {"a": 1})
    write_json(path, {"a": 2})
    assert path.read_text() == '{\n  "a": 2\n}\n'
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


@pytest.mark.parametrize(
    ("number", "remedy"), [(errno.ENOSPC, "free some space"), (errno.EACCES, "may be written to")]
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
