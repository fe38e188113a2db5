"""What surrounds every command, from its first line to its exit code. Imports nothing slow."""

import io
import logging
import os
import signal
import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TextIO

from imfvla.errors import UserError, as_user_error
from imfvla.process.signals import Stopped, StopRequest, stop_at_once, stoppable
from imfvla.process.visible import VisibleStream, visible

EXIT_FAILURE, EXIT_USER_ERROR = 1, 2
P = ParamSpec("P")


def begin() -> None:
    """The first call of a command's file, before its other imports, which take seconds.

    A signal ends the process without a traceback. Standard output and standard error escape what their encoding
    lacks and characters that would act on a terminal, are always open, and drop what is written once nobody reads it
    any more.
    """
    stop_at_once()
    logging.raiseExceptions = False  # a line of a log that cannot be written is dropped too
    _open_standard_streams()
    sys.stdout, sys.stderr = _stream(sys.stdout, 1), _stream(sys.stderr, 2)


def as_command(function: Callable[P, int | None]) -> Callable[P, int]:
    """Decorator: the function returns its exit code (None for 0), also after a stop or a user's mistake.

    2 after a UserError or a system error that the user can correct, whose sentence goes to stderr; 130, 143 or 138
    after Ctrl-C, SIGTERM or SIGUSR1. Other errors are raised.
    """

    @wraps(function)
    def main(*args: P.args, **kwargs: P.kwargs) -> int:
        request = StopRequest()
        try:
            with stoppable() as request:
                _check_working_directory()
                code = function(*args, **kwargs) or 0
                # Flushed here: the interpreter could not report an error of its own flush at exit.
                sys.stdout.flush()
        except Stopped as stop:
            request.number = stop.number
        except KeyboardInterrupt:
            request.number = signal.SIGINT
        except Exception as error:
            known = as_user_error(error)
            if request.number is None and known is None:
                raise
            if request.number is None:
                print(visible(str(known)), file=sys.stderr)
                return EXIT_USER_ERROR
        if request.number is None:
            return code
        stop = Stopped(request.number)
        print(stop.sentence, file=sys.stderr)
        return stop.exit_code

    return main


class _Output(io.FileIO):
    """File 1 or 2. Drops failed writes, but raises the first error of file 1, unless its reader has left."""

    _has_failed = False

    def write(self, data: bytes) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if self.fileno() == 1 and not self._has_failed and not isinstance(error, BrokenPipeError):
                self._has_failed = True
                raise OSError(error.errno, error.strerror, "standard output") from error
            return len(data)


def _open_standard_streams() -> None:
    """Makes sure that files 0, 1 and 2 exist: otherwise the next opened file would be one of them and get messages."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


def _stream(usual: TextIO | None, descriptor: int) -> TextIO:
    """`usual`, or a replacement where it was closed, with the behaviour that `begin` promises."""
    output = _Output(descriptor, "w", closefd=False)
    is_unbuffered = usual is not None and usual.write_through  # PYTHONUNBUFFERED
    return VisibleStream(
        output if is_unbuffered else io.BufferedWriter(output),
        encoding=usual.encoding if usual else "utf-8",
        errors="backslashreplace",
        line_buffering=descriptor == 2 or (usual is not None and usual.line_buffering),
        write_through=is_unbuffered,
    )


def _check_working_directory() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise UserError("The working directory is gone: change into one that exists.") from None
