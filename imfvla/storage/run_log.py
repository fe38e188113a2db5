"""The log file of a run directory, which Hydra opens before any other file there."""

import logging
import os
from io import TextIOWrapper
from pathlib import Path

from imfvla.storage.opening import open_to_append


class RunLog(logging.FileHandler):
    """A handler of logging that appends to a file as `storage.opening` opens it, which is made with the first message.

    A command that is refused before it does anything leaves no log. Raises UserError at once where a link would lead
    out of the run directory, or something else has the name.
    """

    def __init__(self, filename: str | Path) -> None:
        super().__init__(filename, encoding="utf-8", delay=True)
        if os.path.lexists(self.baseFilename):
            self._open().close()

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a message. One that a launcher sends after its refused job has removed the folder has no place."""
        if self.stream is not None or os.path.isdir(os.path.dirname(self.baseFilename)):
            super().emit(record)

    def _open(self) -> TextIOWrapper:
        return open_to_append(Path(self.baseFilename))
