"""Files of runs that a page shows or links to: where they are, or as copies beside the page."""

import os
from pathlib import Path
from urllib.parse import quote

from imfvla.errors import UserError
from imfvla.storage.opening import checked, kind_of

FOLDER = "media"


class Media:
    """Links from a page in `directory`; with `is_copied`, `copies` says what must be copied beside it."""

    def __init__(self, directory: Path, *, is_copied: bool) -> None:
        self._directory, self._is_copied = directory, is_copied
        self.copies: dict[Path, tuple[Path, Path]] = {}  # copy -> original, run directory

    def link(self, path: Path, run: Path) -> str | None:
        """A relative address of a file, and of a directory where nothing is copied; None where there is none.

        Raises UserError where a file to be copied is none, or does not lie in its run directory.
        """
        if not path.exists() or (self._is_copied and path.is_dir()):
            return None
        target = self._copy_of(path, run) if self._is_copied else path
        return quote(os.fsencode(Path(os.path.relpath(target, self._directory)).as_posix()))

    def _copy_of(self, path: Path, run: Path) -> Path:
        checked(path, kind_of(path), home=run)
        parts = [part for part in path.parts if part not in ("..", path.anchor)]
        copy = self._directory / FOLDER / Path(*parts)
        if self.copies.setdefault(copy, (path, run))[0].resolve() != path.resolve():
            raise UserError(
                f"{path} and {self.copies[copy][0]} would both become {copy}: rename the directory of one."
            )
        return copy
