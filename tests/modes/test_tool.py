"""tools/modes.py from a run directory and recordings to a table, a figure and numbers."""

import json
import sys

import numpy as np
import pytest
import torch
from synthetic import write_demonstrations
from test_hostile_files import load_tool

from imfvla.command.composition import compose
from imfvla.data.statistics import Statistics
from imfvla.policy import build_policy
from imfvla.sources.collection import recording_path
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import save_weights

RUN = [
    "+exp=socket_ph32_exec16", "observation.image_size=[32,32]", "demos.episodes=2", "horizon.pred=8",
    "horizon.exec=4", "size.width=20", "core.depth=1", "training.steps=5",
]  # fmt: skip


@pytest.fixture
def run(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    config = compose("train", RUN)
    directory.claim(config)
    numbers = np.random.default_rng(0).normal(size=(50, 16)).astype(np.float32)
    chunks = np.repeat(numbers[:, None], 8, axis=1)
    torch.manual_seed(0)
    policy = build_policy(config, Statistics.of(numbers, numbers, chunks, np.ones((50, 8), bool)))
    save_weights(directory.weights_directory(5), policy, {"step": 5})
    return directory.path


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
