"""Being asked to stop: Ctrl-C, SIGTERM (a batch system takes the node back), SIGUSR1 (its time is nearly up).

Everything that a command writes is whole or absent at any moment, so a stop may come anywhere. Training alone puts it
off to the end of the step, to keep the steps since the last save.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


class Stopped(KeyboardInterrupt):
    """A signal asked this process to stop; what was done so far is kept, and the same command goes on."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """As shells say it: 130 after Ctrl-C, 143 after SIGTERM, 138 after SIGUSR1."""
        return 128 + self.number


class StopRequest:
    """`number` is the signal that came, None for none so far."""

    number: int | None = None


@contextmanager
def stoppable() -> Iterator[None]:
    """Inside, each of `SIGNALS` raises `Stopped` where the process happens to be."""

    def stop(number: int, frame: object) -> None:
        raise Stopped(number)

    with _handling(stop):
        yield


@contextmanager
def deferred_stop() -> Iterator[StopRequest]:
    """Inside, the first of `SIGNALS` is noted in what is yielded; a second one raises `Stopped` at once."""
    request = StopRequest()

    def note(number: int, frame: object) -> None:
        if request.number is not None:
            raise Stopped(number)
        request.number = number

    with _handling(note):
        yield request


@contextmanager
def _handling(handler: Callable[[int, object], None]) -> Iterator[None]:
    """Handlers belong to the main thread: in another one nothing is changed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
