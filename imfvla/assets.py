"""Where the files are that commands read beside code: next to the package in a clone, inside it in a wheel."""

from pathlib import Path

import imfvla


def folder(name: str) -> Path:
    """The folder `conf` or `experiments` of this installation; that of a clone where the package has none."""
    package = Path(imfvla.__file__).resolve().parent
    inside = package / name
    # The package first: in site-packages a folder of that name beside it would be another package's.
    return inside if inside.is_dir() else package.parent / name
