"""A folder that is whole or absent: filled beside its place, then renamed."""

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from imfvla.storage.files import clear_write_errors, locked, make_folder, put_folder, refuse_existing

EXISTING = "choose another path, for a new folder"


class NewFolder:
    """`with NewFolder(path, close, abort) as part: ...` fills `part`, which becomes `path` at the end.

    `close` is called before that, `abort` after an error; then nothing is left. Raises UserError where something is at
    `path` already, or nothing can be written there.
    """

    def __init__(self, path: Path, close: Callable[[], None], abort: Callable[[], None]) -> None:
        self.path, self._close, self._abort = path, close, abort
        self.part = path.with_name(f".{path.name}.part")
        refuse_existing(path, EXISTING)

    def __enter__(self) -> Path:
        with ExitStack() as held:
            held.enter_context(locked(self.path))
            refuse_existing(self.path, EXISTING)  # another process may have made it meanwhile
            with clear_write_errors(self.path):
                shutil.rmtree(self.part, ignore_errors=True)  # of a killed process
                make_folder(self.path.parent)
                self.part.mkdir()
            self._held = held.pop_all()
        return self.part

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._held:
            try:
                if error is None:
                    with clear_write_errors(self.path):
                        self._close()
                        put_folder(self.part, self.path)
            except BaseException:
                self._remove()
                raise
            if error is not None:
                self._remove()

    def _remove(self) -> None:
        self._abort()
        shutil.rmtree(self.part, ignore_errors=True)
