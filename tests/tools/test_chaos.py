"""tools/chaos.py in short: killed and stopped work comes back to the same result; what differs is reported."""

import os
import subprocess
import sys
from pathlib import Path

from test_hostile_files import load_tool

ROOT = Path(__file__).resolve().parents[2]


def chaos(*what: str) -> str:
    """What the harness prints."""
    command = [sys.executable, str(ROOT / "tools" / "chaos.py"), *what, "--kills", "3"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_killed_and_stopped_work_comes_back_to_the_same_result():
    printed = chaos("training", "collection", "evaluation", "stops")
    assert printed.count("3 kills") == 3
    assert "exit codes [130, 138, 143]" in printed


def test_silent_changes_are_refused_by_name_or_change_nothing():
    printed = chaos("changes")
    assert printed.startswith("changes: 3 changes of a training's data")
    assert "all refused by name, or without effect" in printed


def test_a_killed_sweep_comes_to_the_same_end():
    assert "parts of 2 runs equal bit for bit" in chaos("sweep")


def test_torchrun_brings_back_what_one_death_ended():
    assert chaos("torchrun").startswith("torchrun: 1 kills")


def test_strangers_collisions_and_leftovers_do_no_harm():
    printed = chaos("strangers", "publications", "reports", "no_locks", "nfs", "leftovers")
    assert "none followed or waited for" in printed
    assert printed.count("none failed, none were mixed") == 2


def test_a_killed_conversion_or_export_leaves_a_whole_folder_or_none():
    assert "4 at once made one folder each time" in chaos("folders")


def test_the_harness_tells_a_difference(tmp_path, capsys):
    path = list(sys.path)
    try:
        chaos = load_tool("chaos")
        from faults.outcome import compare
    finally:
        sys.path[:] = path

    def damage(folder, kills, rng):
        return f"{compare({'a': 1, 'b': 2}, {'a': 1, 'b': 3})} parts"

    chaos.FAULTS = {"training": damage}
    chaos.sys.argv = ["chaos.py", "training"]
    assert chaos.main() == 1
    assert "FAILED: 1 of 2 parts differ: b" in capsys.readouterr().out
