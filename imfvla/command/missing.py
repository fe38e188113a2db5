"""Mandatory values (`???` in the YAML) that nobody gave: all in one sentence, with what the YAML says of each."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from imfvla.config.assets import folder, shown
from imfvla.errors import UserError

LINE = re.compile(r"(\w+):\s*\?\?\?\s*(?:#\s*(.*?)\s*)?")  # key: ??? # what it is


def refuse_missing(config: DictConfig) -> None:
    """Raises UserError naming every key of the config that has no value."""
    missing = sorted(OmegaConf.missing_keys(config))
    if not missing:
        return
    groups: dict[str, list[str]] = {}
    for key in missing:
        groups.setdefault(key.rpartition(".")[0], []).append(key)
    named, files = [], []
    for parent, keys in groups.items():
        file = _file_of(OmegaConf.select(config, parent) if parent else config)
        notes = _notes(file) if file else {}
        files += [shown(file)] if file else []
        for key in keys:
            note = notes.get(key.rpartition(".")[2])
            named.append(f"{key} ({note})" if note else key)
    explained = f"; see {' and '.join(files)}" if files else ""
    raise UserError(
        f"Missing {'value' if len(named) == 1 else 'values'} of {', '.join(named)}: give each in your YAML or on the "
        f"command line as {missing[0]}=...{explained}."
    )


def _file_of(group: Any) -> Path | None:
    """The YAML file in `conf` that has the group's keys, which a user's own file that starts from it has too."""
    wanted = set(group) if isinstance(group, Mapping | DictConfig) else set()
    for path in sorted(folder("conf").glob("*/*.yaml")):
        found = OmegaConf.load(path)
        if isinstance(found, DictConfig) and set(found) == wanted:
            return path
    return None


def _notes(path: Path) -> dict[str, str]:
    """Key -> the comment beside it."""
    lines: Iterable[str] = path.read_text(encoding="utf-8").splitlines()
    found = [match for line in lines if (match := LINE.fullmatch(line))]
    return {match[1]: match[2] for match in found if match[2]}
