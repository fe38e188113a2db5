"""The curves of a training as TensorBoard reads them: one file of events per process that trained.

TensorBoard's own writer has a thread, which meets a full disk on its own and prints a traceback.
"""

import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from imfvla.storage.appended import AppendedFile

VERSION = "brain.Event:2"  # of the format


class EventFile:
    """A new file in `folder`; TensorBoard drops what earlier ones have from `first_step` on.

    Raises UserError where it cannot be written. It is not forced to disk.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}"
        self._file = AppendedFile(folder / name)
        self._records = RecordWriter(self._file)
        self._add(Event(file_version=VERSION))
        self._add(Event(step=first_step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, scalars: Mapping[str, float], step: int) -> None:
        """Adds a point to the curve of each name."""
        values = [Summary.Value(tag=name, simple_value=value) for name, value in scalars.items()]
        self._add(Event(step=step, summary=Summary(value=values)))

    def close(self) -> None:
        self._file.close()

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        self._records.write(event.SerializeToString())
