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
from imfvla.process import running_time
from imfvla.process.workers import worker_pool


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


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ((os._exit, (1,)), r"ended \(exit code 1\), 3 times .*: its own last output is printed above"),
        ((signal.raise_signal, (9,)), r"was killed \(SIGKILL\), 3 times .* choose fewer workers"),
        ((signal.raise_signal, (11,)), r"crashed \(SIGSEGV\), 3 times .* export MUJOCO_GL=osmesa"),
    ],
)
def test_the_death_of_a_worker_is_reported_with_its_reason_and_the_remedy(call, words):
    function, arguments = call
    with pytest.raises(UserError, match=words), worker_pool(1) as run_all:
        list(run_all(function, [arguments]))


class OddError(Exception):
    """Cannot be made again from its arguments, as pickle does."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def raise_odd_error() -> None:
    raise OddError(1, 2)


class OnlyHere:
    """Of a module that no other process can import."""


OnlyHere.__module__ = "nowhere"


def test_whatever_a_worker_raises_arrives(monkeypatch):
    nowhere = monkeypatch.setitem(sys.modules, "nowhere", sys.modules[__name__])
    assert nowhere is None
    with worker_pool(1) as run_all:
        with pytest.raises(RuntimeError, match="OddError: 1 and 2"):
            list(run_all(raise_odd_error, [()]))
        with pytest.raises(RuntimeError, match="SystemExit: enough"):
            list(run_all(sys.exit, [("enough",)]))
        with pytest.raises(ModuleNotFoundError, match="No module named 'nowhere'"):
            list(run_all(print, [(OnlyHere(),)]))
        assert run_all.incidents == 0


def test_a_script_needs_no_guard(tmp_path):
    lines = (
        "from imfvla.process.workers import worker_pool",
        "with worker_pool(1) as do:",
        "    print(*do(abs, [(-3,)]))",
    )
    (tmp_path / "script.py").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "3\n", "")


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
        "import os, signal, time; from imfvla.process.workers import worker_pool\n"
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


def test_a_worker_is_not_late_because_its_parent_was_stopped(monkeypatch):
    """Ctrl-Z for a quarter of an hour, a second after a call was sent."""
    stopped_s, clock = 900.0, time.monotonic
    with worker_pool(1, timeout_s=300.0) as run_all:
        assert list(run_all(abs, [(-1,)])) == [1]
        began = clock()
        monkeypatch.setattr(
            running_time.time, "monotonic", lambda: clock() + (stopped_s if clock() > began + 1.0 else 0.0)
        )
        assert list(run_all(time.sleep, [(3.0,)])) == [None]
        assert run_all.incidents == 0
