"""Requests to stop: Ctrl-C, SIGTERM (a batch system takes the node back), SIGUSR1 (its time is nearly up).

Everything that a command writes is whole or absent at any moment, so a stop may come anywhere. Only training
delays it to the end of the step, to keep the steps since the last save.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
Handler = Callable[[int, FrameType | None], None]


class Stopped(KeyboardInterrupt):
    """A signal asked this process to stop; what was done so far is kept, and rerunning the same command resumes."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """The exit code by the shells' convention: 130 after Ctrl-C, 143 after SIGTERM, 138 after SIGUSR1."""
        return 128 + self.number

    @property
    def sentence(self) -> str:
        """What a command prints at its end."""
        if self.number == signal.SIGINT:
            return "Interrupted."
        return f"Stopped by {signal.Signals(self.number).name}; rerun the same command to resume."


class StopRequest:
    """`number` is the signal that came, None for none so far."""

    number: int | None = None


def stop_at_once() -> None:
    """From here on each of `SIGNALS` ends this process with its sentence and exit code."""
    for number in SIGNALS:
        signal.signal(number, _end)


@contextmanager
def stoppable() -> Iterator[StopRequest]:
    """Inside the block, each of `SIGNALS` raises `Stopped` wherever the process is.

    The yielded request notes it too, since libraries may turn exceptions raised inside them into their own errors.
    While modules are imported it ends the process instead: the import system drops exceptions of its callbacks.
    """
    request = StopRequest()

    def stop(number: int, frame: FrameType | None) -> None:
        if _is_importing(frame):
            _end(number, frame)
        request.number = number
        raise Stopped(number)

    with _handling(stop):
        yield request


@contextmanager
def deferred_stop() -> Iterator[StopRequest]:
    """Inside the block, the first of `SIGNALS` is noted in the yielded request; a second one raises `Stopped`."""
    request = StopRequest()

    def note(number: int, frame: FrameType | None) -> None:
        if request.number is not None:
            raise Stopped(number)
        request.number = number

    with _handling(note):
        yield request


@contextmanager
def held_back() -> Iterator[None]:
    """`SIGNALS` wait for the end of the block; a process started inside begins with them blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_stops() -> None:
    """Ignores `SIGNALS` in a process that its parent ends: a terminal sends them to both."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _end(number: int, frame: FrameType | None) -> None:
    stop = Stopped(number)
    with suppress(OSError):
        os.write(2, f"{stop.sentence}\n".encode())
    os._exit(stop.exit_code)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


@contextmanager
def _handling(handler: Handler) -> Iterator[None]:
    """Only the main thread can set handlers: in another thread nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
