"""A folder that is whole or absent: filled beside its place, then renamed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from imfvla.errors import UserError
from imfvla.storage.files import clear_write_errors


class NewFolder:
    """`with NewFolder(path, close, abort) as part: ...` fills `part`, which becomes `path` at the end.

    `close` is called before that, `abort` after an error; then nothing is left. Raises UserError where something is at
    `path` already, or nothing can be written there.
    """

    def __init__(self, path: Path, close: Callable[[], None], abort: Callable[[], None]) -> None:
        self.path, self._close, self._abort = path, close, abort
        self.part = path.with_name(f".{path.name}.part")
        if os.path.lexists(path):
            raise UserError(f"{path} exists already, wanted a new folder: choose another path.")

    def __enter__(self) -> Path:
        with clear_write_errors(self.path):
            shutil.rmtree(self.part, ignore_errors=True)  # of a killed process
            self.part.mkdir(parents=True)
        return self.part

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                with clear_write_errors(self.path):
                    self._close()
                    self.part.rename(self.path)
        except BaseException:
            self._remove()
            raise
        if error is not None:
            self._remove()

    def _remove(self) -> None:
        self._abort()
        shutil.rmtree(self.part, ignore_errors=True)
