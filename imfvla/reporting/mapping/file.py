"""Reads a file like `experiments/tables.yaml`: mappings that know their lines, and messages that name them."""

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from imfvla.errors import UserError
from imfvla.options import require, shown, suggestion
from imfvla.storage.documents import ChosenLoader, read_yaml

_LINE = "__line__"


def load(path: Path) -> dict[str, Any]:
    """The content of a file. Raises UserError where it is no YAML or gives a key twice."""
    try:
        content = read_yaml(path, _Loader)
    except OSError as error:
        raise UserError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error
    return plain(content, str(path))


def plain(entry: Any, where: str) -> dict[str, Any]:
    """A mapping of the file without its line. Raises UserError where it is none."""
    if not isinstance(entry, dict):
        raise UserError(f"{where} must be a mapping of keys to values, found {shown(entry)}.")
    for key in entry:
        require(isinstance(key, str), f"a key of {where}", "a text", key)
    return {key: value for key, value in entry.items() if key != _LINE}


def place_of(entry: Any, what: str, path: Path) -> str:
    """File and line of an entry, which heads messages about it."""
    line = entry.get(_LINE) if isinstance(entry, dict) else None
    return f"{path}, line {line}, {what}" if line else f"{path}, {what}"


def entries(content: dict[str, Any], key: str, path: Path) -> list[Any]:
    """The rows of a table. Raises UserError where they are no list."""
    if not isinstance(content[key], list):
        raise UserError(f"{path}: {key} must be a list of rows, found {shown(content[key])}.")
    return content[key]


def named(name: str, known: dict[str, Any], problem: str) -> Any:
    """What is called `name`. Raises UserError with all that there is."""
    if name not in known:
        raise UserError(f"{problem} {name!r}{suggestion(name, known)}; known are {', '.join(known)}.")
    return known[name]


class _Loader(ChosenLoader):
    """Notes for each mapping the line where it begins, and refuses a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        line = node.start_mark.line + 1
        counts = Counter(str(key.value) for key, _ in node.value)
        twice = next((key for key, count in counts.items() if count > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"line {line} has {twice} twice", None)
        return super().construct_mapping(node, deep=True) | {_LINE: line}


_Loader.add_constructor("tag:yaml.org,2002:map", lambda loader, node: loader.construct_mapping(node))
