"""The one grammar of the names of run directories: from overrides to a name, from a name to what it says."""

import hashlib
import re
from collections.abc import Sequence

from imfvla.storage.run_directory import EXECUTION_KEYS

MAX_KEY = 120  # characters
MAX_OPTIONS = 40  # characters of all options of a source together
SOURCE = "demos"
SEED = re.compile(r"seed=\d{1,20}")
DEFAULT = "default"


def run_name(overrides: Sequence[str]) -> str:
    """Directory name that the overrides of a command determine: "default" without any.

    Sorted `key=value` pairs joined by commas, without those that only name the run (exp, name) or say how it executes
    or is evaluated; characters that shells or file systems dislike become "-". Options of a source that are long
    together are a digest behind its name, as in "demos=ros2-1f3a97c2". What is long without the training seed ends with
    a digest, and the seed follows.
    """
    parts = sorted({text.lstrip("+~") for text in overrides if not _is_execution_key(key_of(text))})
    parts = _with_short_source(parts)
    said = [part for part in parts if not _is_seed(part)]
    key = _joined(said)
    if len(key) <= MAX_KEY:
        return _joined(parts) or DEFAULT
    digest = _digest(said)
    seeds = [_plain(part) for part in parts if _is_seed(part)]
    return ",".join([f"{key[: MAX_KEY - 9]}-{digest}", *seeds])


def run_key(name: str) -> str:
    """What the name of a run directory says besides the training seed: "" for "default", "seed=1" and the like.

    `run_key(run_name(overrides))` is the same with and without a `seed=N` among the overrides.
    """
    return "" if name == DEFAULT else _joined([part for part in name.split(",") if not _is_seed(part)])


def key_of(override: str) -> str:
    """The key or group of an override as it is written on a command line."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


def _with_short_source(parts: Sequence[str]) -> list[str]:
    """The parts with the options of the source as a digest, where they are long."""
    options = [part for part in parts if key_of(part).startswith(f"{SOURCE}.")]
    if len(_joined(options)) <= MAX_OPTIONS:
        return list(parts)
    chosen = [part for part in parts if key_of(part) == SOURCE]
    digest = "-".join([*(part.partition("=")[2] for part in chosen), _digest(options)])
    others = [part for part in parts if part not in options and part not in chosen]
    return sorted([*others, f"{SOURCE}={digest}"])


def _digest(parts: Sequence[str]) -> str:
    return hashlib.sha256(",".join(parts).encode()).hexdigest()[:8]


def _joined(parts: Sequence[str]) -> str:
    return ",".join(map(_plain, parts)).strip("-.")


def _plain(part: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", re.sub(r"[\[\]\s]", "", part))


def _is_seed(part: str) -> bool:
    return SEED.fullmatch(_plain(part)) is not None


def _is_execution_key(key: str) -> bool:
    is_name = key in ("exp", "name", "condition") or key.startswith(("hydra.", "hydra/"))
    return is_name or any(key == known or key.startswith(f"{known}.") for known in EXECUTION_KEYS)
