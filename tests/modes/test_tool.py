"""tools/modes.py from a run directory and recordings to a table, a figure and numbers."""

import json
import sys

import pytest
from synthetic import write_demonstrations
from test_hostile_files import load_tool
from untrained_run import untrained_run

from imfvla.sources.collection import recording_path


@pytest.fixture
def run(tmp_path):
    return untrained_run(tmp_path / "run").path


def test_the_tool_reports_on_recordings_that_the_run_was_not_trained_on(tmp_path, run, monkeypatch, capsys):
    demos = write_demonstrations(tmp_path / "demos", num_episodes=4)
    for seed, path in enumerate(sorted(demos.glob("*.mcap"))):
        path.rename(recording_path(demos, seed))
    numbers = ["--nfe", "1", "2", "--samples", "2", "--observations", "4"]
    files = ["--demos", str(demos), "--out", str(tmp_path / "out"), "--json", str(tmp_path / "a.json")]
    monkeypatch.setattr(sys, "argv", ["modes.py", str(run), *numbers, *files])
    assert load_tool("modes").main() == 0
    printed = " ".join(capsys.readouterr().out.split())  # whatever width a title is wrapped at
    assert "socket_ph32_exec16 run, step 5: 2 samples at each observation of 2 demonstrations" in printed
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["seeds"] == [2, 3]
    assert list(found["rows"]) == ["demonstrations", "1", "2"]
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".svg", ".png"}


def test_a_wrong_number_is_told_before_anything_is_read(run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["modes.py", str(run), "--samples", "1"])
    assert load_tool("modes").main() == 2
    assert "--samples must be at least 2, found 1." in capsys.readouterr().err
