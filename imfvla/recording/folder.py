"""Which recordings of a folder belong together: those that are named, whatever other files the folder holds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from imfvla.errors import UserError


@dataclass(frozen=True, slots=True)
class Recordings:
    """Files of one folder, in the order of their names. `name` distinguishes this choice from others."""

    directory: Path
    files: tuple[Path, ...]
    name: str

    @classmethod
    def named(cls, directory: Path, names: Sequence[str], name: str) -> "Recordings":
        return cls(directory, tuple(directory / file for file in sorted(names)), name)

    @classmethod
    def of(cls, directory: str | Path) -> "Recordings":
        """All `*.mcap` of a folder. Raises UserError where there are none."""
        directory = Path(directory)
        files = tuple(sorted(directory.glob("*.mcap")))
        if not files:
            raise UserError(
                f"No recordings (*.mcap) in {directory}: collect demonstrations with "
                "`python -m imfvla.collect`, or correct the directory."
            )
        return cls(directory, files, directory.name)
