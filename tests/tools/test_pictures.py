"""tools/pictures.py: every picture of the documents is one that it makes, and what it lacks is reported."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def pictures(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "tools" / "pictures.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)


def test_every_picture_of_the_documents_has_a_name_there():
    text = pictures("--help").stdout
    assert all(path.stem in text for path in (ROOT / "docs" / "pictures").glob("*.png"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tpy"], "unknown picture tpy; there are evaluations, "),
        (["toy", "--toy", "{tmp}"], "toy.png is missing: make it with python tools/toy.py --out {tmp}"),
        (["two_sentences", "--multitask", "{tmp}"], "{tmp} has no weights in checkpoints"),
    ],
)
def test_what_is_missing_is_reported_and_nothing_written(tmp_path, arguments, message):
    done = pictures(*(text.format(tmp=tmp_path) for text in arguments), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert message.format(tmp=tmp_path) in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
