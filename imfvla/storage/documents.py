"""JSON and YAML files that others may have written or damaged: a value or a UserError, in bounded time and memory."""

import json
import re
from itertools import accumulate
from pathlib import Path
from typing import Any

import yaml

from imfvla.errors import UserError, unreadable
from imfvla.storage.opening import JSON, ROWS, YAML, Kind, open_to_read

MAX_LINES = 1_000_000  # of JSON
# Keys, lists and mappings of JSON: one takes some microseconds to check, a number in a long list far less.
MAX_PARTS = 1_000_000
MAX_YAML_DEPTH = 64
MAX_YAML_VALUES = 20_000  # keys, values, lists and mappings; each takes some 0.1 ms


class ChosenLoader(yaml.SafeLoader):
    """Safe, bounded, and without aliases, nine lines of which unfold to billions of values."""

    num_values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self.num_values += 1
        if self.num_values > MAX_YAML_VALUES:
            raise yaml.YAMLError(f"it has more than {MAX_YAML_VALUES} keys and values")
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1} has an alias, wanted values")
        return super().compose_node(parent, index)


def read_json(path: Path, remedy: str, *, mapping: bool = False, home: Path | None = None) -> Any:
    """The value in `path`, a file in `home`, with `mapping` a dict.

    Raises UserError, ending with `remedy`, where it cannot be read, and where `storage.opening` refuses it.
    """
    try:
        value = parse_json(read_text(path, JSON, home=home))
        if mapping and not isinstance(value, dict):
            raise ValueError(f"wanted a mapping, found {type(value).__name__}")
    except UserError:
        raise
    except PermissionError as error:  # a file that may be intact must not be deleted
        raise unreadable(path, error) from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: {error}; {remedy}.") from error
    return value


def read_yaml(path: Path, loader: type[yaml.SafeLoader] = ChosenLoader, *, home: Path | None = None) -> Any:
    """The value in `path`, a file in `home`.

    Raises FileNotFoundError where it is missing, UserError where it cannot be read or `storage.opening` refuses it.
    """
    try:
        text = read_text(path, YAML, home=home)
        if _bracket_depth(text) > MAX_YAML_DEPTH:
            raise ValueError(f"it is nested deeper than {MAX_YAML_DEPTH} levels")
        return yaml.load(text, Loader=loader)  # a SafeLoader
    except (FileNotFoundError, UserError):
        raise
    except Exception as error:  # an impossible date or deep nesting can raise anything
        raise UserError(f"{path} cannot be read as YAML: {' '.join(str(error).split())}") from error


def _bracket_depth(text: str) -> int:
    """Reading nested brackets takes time that grows with the square of their depth, so the depth is checked first."""
    changes = (1 if match.group() in "[{" else -1 for match in re.finditer(r"[\[\]{}]", text))
    return max(accumulate(changes), default=0)


def read_text(path: Path, kind: Kind, *, home: Path | None = None) -> str:
    """Text of a file in `home`.

    Raises OSError, ValueError (no UTF-8), or UserError where `storage.opening` refuses it.
    """
    with open_to_read(path, kind, home=home) as stream:
        return stream.read().decode("utf-8")


def parse_json(text: str | bytes) -> Any:
    """The value. Raises ValueError, also where it is nested too deeply or has too many parts."""
    refuse_many_parts(text)
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def refuse_many_parts(text: str | bytes, most: int = MAX_PARTS) -> None:
    """Raises ValueError where JSON has more keys, lists and mappings."""
    marks = (b"[", b"{", b":") if isinstance(text, bytes) else ("[", "{", ":")
    if (found := sum(map(text.count, marks))) > most:
        raise ValueError(f"it has {found} keys, lists and mappings, wanted at most {most}")


def read_lines(
    path: Path, remedy: str, *, home: Path | None = None, most_parts: int = MAX_PARTS
) -> list[str]:
    """The lines of a text in `home`, ends kept; all JSON in them has at most so many parts.

    Raises UserError, ending with `remedy`, where it cannot be read, and where `storage.opening` refuses it.
    """
    try:
        text = read_text(path, ROWS, home=home)
        if (found := text.count("\n")) > MAX_LINES:
            raise ValueError(f"it has {found} lines, wanted at most {MAX_LINES}")
        refuse_many_parts(text, most_parts)
        return text.splitlines(keepends=True)
    except UserError:
        raise
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}; {remedy}.") from error
