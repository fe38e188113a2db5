"""Checksums of the files of a frame store, in blocks, so that a changed byte is found and its place is named.

CRC-32 finds every accidental change but one in 4 billion, and is the fastest checksum of the standard library. It is
no protection against somebody who computes a new one.
"""

import hashlib
import json
import logging
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imfvla.storage.opening import ARRAY, open_to_read

KEY = "checksums"  # in a store's meta.json
META = "meta.json"
BLOCK_BYTES = 16 * 2**20
CHUNK_BYTES = 256 * 2**10  # stays in the processor's cache between reading and summing
MOST_NAMED = 8  # blocks of a file in a message
log = logging.getLogger(__name__)

Sums = dict[str, list[str]]  # file name -> CRC-32 of each block, 8 hex digits
_seen: dict[Path, tuple[Any, Sums]] = {}  # stores that this process has read, and what their files were then


def block_sums(path: Path) -> list[str]:
    """CRC-32 of each block of a file, 8 hex digits. Raises UserError for what is no file, and OSError."""
    found, buffer = [], memoryview(bytearray(CHUNK_BYTES))
    with open_to_read(path, ARRAY) as stream:
        value = filled = 0
        while count := stream.readinto(buffer[: min(CHUNK_BYTES, BLOCK_BYTES - filled)]):
            value, filled = zlib.crc32(buffer[:count], value), filled + count
            if filled == BLOCK_BYTES:
                found.append(f"{value:08x}")
                value = filled = 0
    return [*found, f"{value:08x}"] if filled else found


def with_checksums(meta: Mapping[str, Any], folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """The content of a store's meta.json with the checksums of itself and of the files beside it."""
    sums = {name: block_sums(folder / name) for name in names}
    return {**meta, KEY: {"block_bytes": BLOCK_BYTES, **sums, META: _sum_of(meta)}}


def checked_sums(folder: Path, meta: Mapping[str, Any], names: Sequence[str]) -> Sums:
    """The checksums of the files as they are, compared with those of `meta` where it has any.

    A process reads a store once; later calls return what was found, unless a file has changed since. Raises
    ValueError naming files and blocks that differ, and OSError.
    """
    state = _state_of(folder, names)
    known, sums = _seen.get(folder.resolve(), (None, {}))
    if known == state:
        return sums
    if KEY in meta and meta[KEY][META] != _sum_of({key: meta[key] for key in meta if key != KEY}):
        raise ValueError(f"{META} is not as it was written")
    if KEY in meta:
        _compare_lengths(folder, meta[KEY], names)  # before terabytes are read
    sums = {name: block_sums(folder / name) for name in names}
    if KEY in meta:
        _compare(sums, meta[KEY], names)
    else:
        log.warning(
            "%s was written before frame stores had checksums, so its arrays are not checked: delete it, and it is "
            "decoded again with checksums.",
            folder,
        )
    _seen[folder.resolve()] = state, sums
    return sums


def remember(folder: Path, meta: Mapping[str, Any], names: Sequence[str]) -> None:
    """Spares this process from reading a store that it has just written, whose meta.json is `meta`."""
    sums = {name: list(meta[KEY][name]) for name in names}
    _seen[folder.resolve()] = _state_of(folder, names), sums


def digest_of(value: Any) -> str:
    """16 hex digits of a JSON-able value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _compare_lengths(folder: Path, written: Mapping[str, Any], names: Sequence[str]) -> None:
    if written["block_bytes"] != BLOCK_BYTES:
        raise ValueError(f"its checksums are of {written['block_bytes']} bytes, wanted {BLOCK_BYTES}")
    for name in names:
        if -(-(folder / name).stat().st_size // BLOCK_BYTES) != len(written[name]):
            raise ValueError(f"{name} has another length than when it was written")


def _compare(found: Sums, written: Mapping[str, Any], names: Sequence[str]) -> None:
    faults = [_difference(name, found[name], written[name]) for name in names if found[name] != written[name]]
    if faults:
        raise ValueError("; ".join(faults))


def _difference(name: str, found: Sequence[str], written: Sequence[str]) -> str:
    places = [number for number, pair in enumerate(zip(found, written, strict=True), 1) if pair[0] != pair[1]]
    named = ", ".join(map(str, places[:MOST_NAMED])) + f" and {len(places) - MOST_NAMED} more" * (
        len(places) > MOST_NAMED
    )
    size = f"of {BLOCK_BYTES // 2**20} MiB"
    return f"{name} is not as it was written, in block {named} of {len(written)} {size}"


def _sum_of(meta: Mapping[str, Any]) -> str:
    return digest_of(json.loads(json.dumps(meta)))  # as it is read back


def _state_of(folder: Path, names: Sequence[str]) -> Any:
    """Changes with the files of a store, as far as the file system tells."""
    stats = [(folder / name).stat() for name in (*names, META)]
    return [(stat.st_ino, stat.st_size, stat.st_mtime_ns) for stat in stats]
