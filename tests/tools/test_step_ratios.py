"""Ratios of training steps: what is measured, and which of the times counts."""

import runpy
import time
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "step_ratios.py"


@pytest.fixture(scope="module")
def tool():
    return runpy.run_path(str(TOOL))


def test_without_compiling_both_residuals_are_measured(tool, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    tool["main"](["--only", "flow_high_noise", "--no-compile", "--rounds", "1"])
    eager, fixed = (line for line in capsys.readouterr().out.splitlines() if "flow_high_noise" in line)
    assert "1.00" in eager
    assert "fixed residuals" in fixed


def test_the_fastest_of_each_counts(tool, monkeypatch):
    now = iter([0.0, 3.0, 3.0, 4.0, 4.0, 6.0, 6.0, 11.0])
    monkeypatch.setattr(time, "process_time", lambda: next(now))
    assert tool["fastest_ms"]([lambda: None, lambda: None], rounds=2) == [2000.0, 1000.0]
