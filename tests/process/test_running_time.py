"""Time limits do not run while this process is stopped."""

import os
import signal
import subprocess
import sys
import time

import pytest

from imfvla.process import running_time
from imfvla.process.running_time import TICK_S, RunningTime, run

LATE = 3.0  # [s] a stop that is longer than the limits below


def clock(monkeypatch, *moments):
    """Answers with these times, one a call."""
    left = list(moments)
    monkeypatch.setattr(running_time.time, "monotonic", lambda: left.pop(0))


def test_time_in_which_the_process_was_stopped_does_not_count(monkeypatch):
    clock(monkeypatch, 0.0, 0.5, 0.5 + TICK_S, 1000.0, 1000.5)
    passed = RunningTime()
    assert passed() == 0.5
    assert passed() == 0.5 + TICK_S
    assert passed() == 0.5 + 3 * TICK_S
    assert passed() == 1.0 + 3 * TICK_S


def test_output_and_code_of_a_process_come_back():
    done = run([sys.executable, "-c", "import sys; print('said'); sys.exit(3)"], 60.0)
    assert (done.returncode, done.stdout) == (3, b"said\n")


def test_a_process_that_takes_too_long_is_killed():
    with pytest.raises(subprocess.TimeoutExpired):
        run([sys.executable, "-c", "import time; time.sleep(3600)"], 0.1)


def test_a_stopped_process_does_not_call_its_child_late():
    lines = (
        "import sys, time",
        "from imfvla.process.running_time import run",
        "print('begun', flush=True)",
        "run([sys.executable, '-c', 'import time; time.sleep(1)'], 2.5)",
    )
    with subprocess.Popen([sys.executable, "-c", "\n".join(lines)], stdout=subprocess.PIPE) as child:
        assert child.stdout.readline()
        os.kill(child.pid, signal.SIGSTOP)
        time.sleep(LATE)
        os.kill(child.pid, signal.SIGCONT)
    assert child.returncode == 0
