"""The description of a recording, mostly without reading its content."""

import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Metadata

from imfvla.episode import EpisodeInfo
from imfvla.recording import messages
from imfvla.recording.mcap_file import (
    DATA_END_SIZE,
    FOOTER_SIZE,
    MAGIC,
    RECORD_HEAD,
    clear_read_errors,
    records,
)
from imfvla.storage.opening import RECORDING, open_to_read, size_of


@dataclass(frozen=True, slots=True)
class EpisodeIndex:
    """The description of a recording, without its content."""

    num_bytes: int
    num_steps: int
    num_frames: Mapping[str, int]  # view -> number of frames
    data_crc: int  # CRC-32 of everything recorded
    info: EpisodeInfo  # without its config


def read_index(path: str | Path) -> EpisodeIndex:
    """The index of a recording, from its summary; the whole file is read where the summary is not enough.

    Raises UserError where the file is missing, incomplete or not one of ours.
    """
    path = Path(path)
    with clear_read_errors(path):
        return _summarised(path) or _counted(path)


def _summarised(path: Path) -> EpisodeIndex | None:
    """The index of a file whose writer left counts, metadata and a checksum at its end, else None."""
    with open_to_read(path, RECORDING) as stream:
        num_bytes = size_of(stream)
        reader = SeekingReader(stream, record_size_limit=num_bytes)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            return None
        found = summary.statistics.channel_message_counts
        names = {record.name for record in summary.metadata_indexes}
        if not found or not found.keys() <= summary.channels.keys() or not set(messages.RECORDS) <= names:
            return None
        counts: Counter[str] = Counter()
        for channel, count in found.items():
            counts[summary.channels[channel].topic] += count
        stream.seek(num_bytes - len(MAGIC) - FOOTER_SIZE + RECORD_HEAD.size)
        (summary_start,) = struct.unpack("<Q", stream.read(8))
        stream.seek(summary_start - DATA_END_SIZE)
        opcode, _ = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        (data_crc,) = struct.unpack("<I", stream.read(4))
        if opcode != Opcode.DATA_END or not data_crc:
            return None
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    return _index(path, num_bytes, counts, data_crc, metadata)


def _counted(path: Path) -> EpisodeIndex:
    """The index of a file with an incomplete summary; the checksum is that of the file."""
    with open_to_read(path, RECORDING) as stream:
        data = stream.read()
    topics: dict[int, str] = {}
    counts: Counter[str] = Counter()
    metadata: dict[str, dict[str, str]] = {}
    for record in records(data):
        if isinstance(record, Message):
            counts[topics[record.channel_id]] += 1
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
    return _index(path, len(data), counts, zlib.crc32(data), metadata)


def _index(
    path: Path,
    num_bytes: int,
    counts: Mapping[str, int],
    data_crc: int,
    metadata: Mapping[str, dict[str, str]],
) -> EpisodeIndex:
    messages.require_records(metadata)
    cameras = {topic: count for topic, count in counts.items() if topic.startswith(messages.CAMERA)}
    frames = {topic.removeprefix(messages.CAMERA): count for topic, count in cameras.items()}
    info = messages.read_info(metadata[messages.EPISODE_RECORD], {}, path)
    return EpisodeIndex(num_bytes, counts.get(messages.STATE, 0), frames, data_crc, info)
