"""JSON and YAML files that others may have written or damaged: a value or a UserError, in bounded time and memory."""

import json
import re
from itertools import accumulate
from pathlib import Path
from typing import Any

import yaml

from imfvla.errors import UserError, unreadable

MAX_JSON_BYTES = 64 * 2**20
MAX_YAML_DEPTH = 64
MAX_YAML_BYTES = 256 * 2**10  # read a hundred times more slowly than JSON; a config has some 4 kB


class ChosenLoader(yaml.SafeLoader):
    """Safe, and without aliases, nine lines of which unfold to billions of values."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1} has an alias, wanted values")
        return super().compose_node(parent, index)


def read_json(path: Path, remedy: str, *, mapping: bool = False) -> Any:
    """The value in `path`, with `mapping` a dict. Raises UserError, ending with `remedy`, where it cannot be read."""
    try:
        value = parse_json(read_text(path, MAX_JSON_BYTES))
        if mapping and not isinstance(value, dict):
            raise ValueError(f"wanted a mapping, found {type(value).__name__}")
    except PermissionError as error:  # a file that may be intact must not be deleted
        raise unreadable(path, error) from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: {error}; {remedy}.") from error
    return value


def read_yaml(path: Path, loader: type[yaml.SafeLoader] = ChosenLoader) -> Any:
    """The value in `path`. Raises FileNotFoundError where it is missing, UserError where it cannot be read."""
    try:
        text = read_text(path, MAX_YAML_BYTES)
        if _bracket_depth(text) > MAX_YAML_DEPTH:
            raise ValueError(f"it is nested deeper than {MAX_YAML_DEPTH} levels")
        return yaml.load(text, Loader=loader)  # a SafeLoader
    except FileNotFoundError:
        raise
    except Exception as error:  # an impossible date or deep nesting can raise anything
        raise UserError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error


def _bracket_depth(text: str) -> int:
    """Reading nested brackets takes time that grows with the square of their depth, so the depth is checked first."""
    changes = (1 if match.group() in "[{" else -1 for match in re.finditer(r"[\[\]{}]", text))
    return max(accumulate(changes), default=0)


def read_text(path: Path, limit: int) -> str:
    """Text of at most `limit` bytes. Raises OSError or ValueError (no UTF-8, too long)."""
    with path.open("rb") as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"it is longer than {limit} bytes")
    return data.decode("utf-8")


def parse_json(text: str | bytes) -> Any:
    """The value. Raises ValueError, also where it is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_lines(path: Path, remedy: str) -> list[str]:
    """The lines of a text, ends kept. Raises UserError, ending with `remedy`, where it cannot be read."""
    try:
        return read_text(path, MAX_JSON_BYTES).splitlines(keepends=True)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}; {remedy}.") from error
