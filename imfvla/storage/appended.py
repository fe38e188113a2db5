"""Files to which whole rows are added one by one, and which a reader may meet at any time."""

import os
from contextlib import suppress
from pathlib import Path

from imfvla.storage.files import clear_write_errors, make_folder, sync
from imfvla.storage.opening import open_to_append


class AppendedFile:
    """The file at `path`, made where it is missing; its name is on disk then.

    A row that cannot be written whole, on a full disk for example, is taken back, so that the file ends with a whole
    one. Raises UserError where the file cannot be opened or written, and where `storage.opening` refuses it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with clear_write_errors(path):
            make_folder(path.parent)
            self._file = open_to_append(path)
            sync(path.parent)

    def write(self, row: bytes) -> None:
        """Adds a row, with what ends it. Others can read it at once."""
        descriptor = self._file.fileno()
        with clear_write_errors(self._path):
            before = os.fstat(descriptor).st_size
            try:
                while row:  # a disk that is nearly full takes a part
                    row = row[os.write(descriptor, row) :]
            except OSError:
                with suppress(OSError):
                    os.ftruncate(descriptor, before)
                raise

    def sync(self) -> None:
        """Forces the rows to disk."""
        with clear_write_errors(self._path):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Does not force the rows to disk."""
        with clear_write_errors(self._path):
            self._file.close()
