"""Work distributed to fresh processes with one thread each, or done in this one.

A process that dies or exceeds its time limit (a graphics driver that hangs) is replaced, and its call is repeated.
"""

import copy
import logging
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from types import ModuleType
from typing import Any

from imfvla.errors import UserError
from imfvla.process.running_time import TICK_S, RunningTime
from imfvla.process.signals import held_back, ignore_stops

MAX_ATTEMPTS = 3  # of one call: what kills three workers kills the next one too
log = logging.getLogger(__name__)


class Here:
    """Does the calls one by one in this process, each when its result is asked for."""

    incidents = 0

    def __call__(self, function: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        return (function(*arguments) for arguments in calls)


class Pool:
    """Does the calls in `count` processes; results come as they complete. `incidents` counts replaced processes."""

    def __init__(self, count: int, timeout_s: float | None) -> None:
        self.incidents = 0
        self._timeout_s = timeout_s
        self._workers = [_Worker() for _ in range(count)]

    def __call__(self, function: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        waiting = list(enumerate(calls))[::-1]
        attempts = [0] * len(calls)
        busy: dict[_Worker, tuple[int, tuple[Any, ...], float]] = {}
        passed = RunningTime()
        try:
            while waiting or busy:
                for worker in [worker for worker in self._workers if worker not in busy][: len(waiting)]:
                    number, arguments = waiting.pop()
                    attempts[number] += 1
                    worker.send(function, arguments)
                    busy[worker] = (number, arguments, passed())
                for worker, outcome in self._outcomes(busy, passed):
                    number, arguments, _ = busy.pop(worker)
                    if isinstance(outcome, _Lost):
                        self._replace(worker, outcome, attempts[number])
                        waiting.append((number, arguments))
                        continue
                    succeeded, value = outcome
                    if not succeeded:
                        raise value
                    yield value
        finally:
            for worker in busy:  # the caller stopped reading: nobody needs the results
                self._workers[self._workers.index(worker)] = _Worker(after=worker)

    def _outcomes(self, busy: dict["_Worker", Any], passed: RunningTime) -> list[tuple["_Worker", Any]]:
        """The outcomes of the calls under way: waits for at least one result or loss."""
        while True:
            timeout = None if self._timeout_s is None else TICK_S
            ready = connection.wait([worker.connection for worker in busy], timeout)
            found = [(worker, worker.receive()) for worker in busy if worker.connection in ready]
            if found:
                return found
            late = passed() - (self._timeout_s or 0.0)
            hanging = _Lost(
                f"gave no answer within {self._timeout_s:g} s",
                "if a graphics driver hangs, try export MUJOCO_GL=osmesa",
            )
            if found := [(worker, hanging) for worker, (_, _, began) in busy.items() if began <= late]:
                return found

    def _replace(self, worker: "_Worker", loss: "_Lost", attempts: int) -> None:
        self.incidents += 1
        self._workers[self._workers.index(worker)] = _Worker(after=worker)
        if attempts == MAX_ATTEMPTS:
            raise UserError(
                f"A worker process {loss.what}, {attempts} times over the same episode: {loss.remedy}. Then rerun the "
                "same command; finished episodes are kept."
            )
        log.warning("A worker process %s: its episode is repeated in a fresh one.", loss.what)

    def close(self) -> None:
        for worker in self._workers:
            worker.end()


@contextmanager
def worker_pool(count: int, timeout_s: float | None = None) -> Iterator[Here | Pool]:
    """Yields `run_all(function, calls)`: results of `function(*arguments)` for each call, as they complete.

    The work is done in `count` fresh processes with one thread each, or in this one for 0. A process that dies or
    takes more than `timeout_s` for a call is replaced, and the call is repeated; `run_all.incidents` counts these.
    Raises UserError where that happens to a call three times.
    """
    if count == 0:
        yield Here()
        return
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # inherited by the workers, which read it when they load torch
    try:
        pool = Pool(count, timeout_s)
        try:
            yield pool
        finally:
            pool.close()
    finally:
        os.environ.pop("OMP_NUM_THREADS")
        if before is not None:
            os.environ["OMP_NUM_THREADS"] = before


@dataclass(frozen=True, slots=True)
class _Lost:
    """What happened to a worker that no longer answers, and what the user can do about it."""

    what: str
    remedy: str

    @classmethod
    def by_exit(cls, code: int) -> "_Lost":
        """`code` is the exit code, or minus the signal."""
        if code == -signal.SIGKILL:
            remedy = "Linux does so when memory runs out, so choose fewer workers=..."
            return cls("was killed (SIGKILL)", remedy)
        if code < 0:
            remedy = "if a graphics driver crashed, try export MUJOCO_GL=osmesa"
            return cls(f"crashed ({signal.Signals(-code).name})", remedy)
        return cls(f"ended (exit code {code})", "its own last output is printed above")


class _Worker:
    """A process that serves calls until this one ends; `after` is the worker whose place it takes."""

    def __init__(self, after: "_Worker | None" = None) -> None:
        if after is not None:
            after.end()
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        resource_tracker.ensure_running()  # it would unblock the signals
        with held_back(), _without_main():
            self._process.start()
        theirs.close()  # so that its death closes the connection

    def send(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # dead already, which `receive` reports
            self.connection.send((function, arguments))

    def receive(self) -> tuple[bool, Any] | _Lost:
        try:
            return self.connection.recv()
        except (EOFError, ConnectionResetError):
            self._process.join()
            return _Lost.by_exit(self._process.exitcode)

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self.connection.close()


@contextmanager
def _without_main() -> Iterator[None]:
    """A process that starts inside does not run the user's script, which may lack `if __name__ == "__main__"`."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(calls: connection.Connection) -> None:
    """Answers (function, arguments) with (whether it succeeded, result or exception)."""
    ignore_stops()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            function, arguments = calls.recv()
        except EOFError:
            return
        except Exception as error:
            answer = (False, _sendable(error))
        else:
            answer = _answer(function, arguments)
        try:
            calls.send(answer)
        except Exception as error:
            calls.send((False, RuntimeError(f"{answer[1]!r} cannot be sent back: {error}")))


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    try:
        return True, function(*arguments)
    except (Exception, SystemExit) as error:
        return False, _sendable(error)


def _sendable(error: BaseException) -> Exception:
    """The error with the worker's traceback; where it cannot be sent, or would end a process, a substitute."""
    trace = traceback.format_exc()
    try:
        sent = copy.copy(error)  # rebuilt as the other process would
    except Exception:
        sent = None
    if not isinstance(sent, Exception):
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    sent.add_note(f"In a worker process:\n{trace}")
    return sent


def _die_with_parent() -> None:
    """Ends this process with the one that started it: after a SIGKILL none may keep writing files."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
