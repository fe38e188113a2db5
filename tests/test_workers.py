"""Work in fresh processes and in this one: results, errors and death arrive."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from imfvla.errors import UserError
from imfvla.workers import worker_pool


def threads_and_square(number: int) -> tuple[str | None, int]:
    return os.environ.get("OMP_NUM_THREADS"), number**2


def refuse(text: str) -> None:
    raise UserError(text)


@pytest.mark.parametrize("count", [0, 1])
def test_results_and_errors_arrive(count, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with worker_pool(count) as run_all:
        found = sorted(run_all(threads_and_square, [(2,), (1,)]))
        with pytest.raises(UserError, match="wrong"):
            list(run_all(refuse, [("wrong",)]))
    threads = "1" if count else "3"
    assert found == [(threads, 1), (threads, 4)]
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_in_this_process_work_is_done_one_by_one():
    done: list[int] = []
    with worker_pool(0) as run_all:
        results = run_all(done.append, [(1,), (2,)])
        next(results)
        assert done == [1]


def test_the_death_of_a_worker_is_told_with_the_remedy():
    with pytest.raises(UserError, match=r"died, perhaps for want of memory: choose fewer workers"):  # noqa: SIM117
        with worker_pool(1) as run_all:
            list(run_all(os._exit, [(1,)]))


def fault_once(marker: str, fault: str, number: int) -> int:
    """Dies or hangs the first time it is called with 2."""
    if number == 2 and not Path(marker).exists():
        Path(marker).touch()
        if fault == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(3600)
    return number


@pytest.mark.parametrize("fault", ["dies", "hangs"])
def test_the_call_of_a_worker_that_is_lost_is_made_again_in_a_fresh_one(tmp_path, fault):
    calls = [(str(tmp_path / "marker"), fault, number) for number in range(4)]
    with worker_pool(1, timeout_s=15.0) as run_all:
        assert sorted(run_all(fault_once, calls)) == [0, 1, 2, 3]
        assert run_all.incidents == 1


def test_workers_end_with_the_process_that_started_them(tmp_path):
    script = (
        "import os, signal, time; from imfvla.workers import worker_pool\n"
        "if __name__ == '__main__':\n"
        "    with worker_pool(1) as run_all:\n"
        "        print(*run_all(os.getpid, [()]), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    (tmp_path / "script.py").write_text(script)
    command = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL
    with suppress(psutil.NoSuchProcess):
        psutil.Process(int(done.stdout)).wait(timeout=60)
