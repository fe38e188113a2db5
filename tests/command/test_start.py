"""A mistake in a command is reported before anything slow is imported."""

import subprocess
import sys

import pytest

SLOW = ("torch", "mujoco", "dm_control", "scipy.special", "matplotlib", "cv2", "gymnasium")
# Runs a command in this process and prints which slow modules it has imported.
PROGRAM = f"""
import importlib, sys
name, *sys.argv[1:] = sys.argv[1:]
try:
    importlib.import_module(f"imfvla.{{name}}").main()
except SystemExit as exit:
    code = exit.code
print(code, *(module for module in {SLOW} if module in sys.modules), file=sys.stderr)
"""


@pytest.mark.parametrize(
    "command",
    [
        "train +exp=socket_ph32_exec16 seeed=1",
        "train +exp=sockett",
        "train training.steps=abc",
        "train action_frame=absolut",
        "evaluate",
        "evaluate run=nowhere",
        "evaluate run=nowhere nfe=abc",
        "compare",
        "compare nowhere elsewhere",
        "report run=nowhere",
        "collect episode=3",
        "bench parts=[speed]",
        "bench steps=abc",
        "convert from=lerobot",
    ],
)
def test_a_mistake_is_reported_before_slow_imports(command, tmp_path):
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, *command.split()], cwd=tmp_path, capture_output=True, text=True
    )
    assert found.stderr.splitlines()[-1] == "2", found.stderr
