"""Comparing with LeRobot's ACT: what is asked of it, and what is said where it is missing."""

import runpy
import sys
from pathlib import Path

import pytest

from imfvla.command.composition import compose
from imfvla.command.rehearsal import build_unfitted

PEERS = Path(__file__).resolve().parents[2] / "tools" / "peers.py"
SMALL = ["core.depth=1", "core.style_depth=1", "observation.image_size=[32,32]"]
ANSWERING = """
import json, sys
json.loads(sys.argv[2])
print(json.dumps({"version": "0", "parameters": 1000000}), flush=True)
for line in sys.stdin:
    print(4000.0 if line == "train\\n" else 2000.0, flush=True)
"""


@pytest.fixture(scope="module")
def peers():
    return runpy.run_path(str(PEERS))


def test_the_rival_gets_our_sizes(peers):
    config = compose("train", ["+exp=socket_act", *SMALL])
    sizes = peers["sizes_of"](config, build_unfitted(config), 3, 1)
    assert (sizes["views"], sizes["image_size"]) == (3, [32, 32])
    assert (sizes["state"], sizes["action"], sizes["steps"]) == (16, 16, config["horizon"]["pred"])
    assert sizes["hidden"] == config["core"]["mlp_ratio"] * config["core"]["width"]


def test_a_missing_rival_is_skipped_with_its_reason(peers, capsys, tmp_path):
    assert peers["main"](["--python", str(tmp_path / "python"), *SMALL]) == 0
    assert "LeRobot is not measured" in capsys.readouterr().out


def test_a_rival_that_ends_is_skipped_with_what_it_said(peers, capsys, tmp_path):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho no module named lerobot >&2\nexit 1\n")
    python.chmod(0o755)
    assert peers["main"](["--python", str(python), *SMALL]) == 0
    assert "no module named lerobot" in capsys.readouterr().out


def test_both_are_measured_in_turn(peers, capsys, tmp_path):
    answering = tmp_path / "answering.py"
    answering.write_text(ANSWERING)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} {answering} "$@"\n')
    python.chmod(0o755)
    assert peers["main"](["--python", str(python), "--eager", "--batch", "1", "--rounds", "2", *SMALL]) == 0
    printed = capsys.readouterr().out
    assert "ACT here and in LeRobot 0" in printed
    assert "4000.0" in printed
    assert "2000.0" in printed
