"""The log file of a run directory, which Hydra opens before any other file there."""

import logging
from io import TextIOWrapper
from pathlib import Path

from imfvla.storage.opening import open_to_append


class RunLog(logging.FileHandler):
    """A handler of logging that appends to a file as `storage.opening` opens it.

    Raises UserError where a link would lead out of the run directory, or something else has the name.
    """

    def _open(self) -> TextIOWrapper:
        return open_to_append(Path(self.baseFilename))
