"""Where the files are that commands read beside code: next to the package in a clone, inside it in a wheel."""

from pathlib import Path

import imfvla

PACKAGE = Path(imfvla.__file__).resolve().parent


def folder(name: str) -> Path:
    """The folder `conf` or `experiments` of this installation; that of a clone where the package has none."""
    inside = PACKAGE / name
    # The package first: in site-packages a folder of that name beside it would be another package's.
    return inside if inside.is_dir() else PACKAGE.parent / name


def shown(path: Path) -> str:
    """A file of this installation as a user opens it: from the working directory where it lies below, else absolute."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def install_command(extra: str) -> str:
    """What installs an extra of pyproject.toml: from the clone where this is one, else for the installed wheel."""
    is_wheel = folder("conf").parent == PACKAGE
    return f"pip install 'imfvla[{extra}]'" if is_wheel else f"pip install -e '.[{extra}]'"
