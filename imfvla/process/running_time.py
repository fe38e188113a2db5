"""Time limits that do not run while this process is stopped: by Ctrl-Z or in a frozen container."""

import subprocess
import time
from collections.abc import Sequence
from typing import Any

TICK_S = 1.0


class RunningTime:
    """Seconds since it was made, without those in which this process was stopped.

    It must be called every `TICK_S`: what comes later than twice that is taken for a stop.
    """

    def __init__(self) -> None:
        self._total, self._last = 0.0, time.monotonic()

    def __call__(self) -> float:
        now = time.monotonic()
        self._total += min(now - self._last, 2 * TICK_S)
        self._last = now
        return self._total


def run(command: Sequence[str], timeout_s: float, **options: Any) -> subprocess.CompletedProcess[bytes]:
    """`subprocess.run` with the output captured. Raises OSError, and TimeoutExpired after killing the process."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options) as child:
        try:
            passed = RunningTime()
            while True:
                try:
                    output, errors = child.communicate(timeout=TICK_S)
                except subprocess.TimeoutExpired:
                    if passed() >= timeout_s:
                        raise
                else:
                    return subprocess.CompletedProcess(command, child.returncode, output, errors)
        except BaseException:
            child.kill()
            raise
