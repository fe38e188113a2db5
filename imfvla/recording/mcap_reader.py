"""Reads recorded episodes back, and refuses those that are not whole."""

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from imfvla.documents import parse_json
from imfvla.episode import EpisodeInfo, EpisodeResult
from imfvla.errors import UserError
from imfvla.recording import messages
from imfvla.recording.pictures import decode

_DATA_END = struct.Struct("<BQI")  # record before the summary: opcode, length, CRC of everything before it
_DATA_END_OPCODE = 0x0F
MAX_CHUNK_BYTES = 256 * 2**20  # of one chunk, unpacked; ours have 1 MiB
MAX_EPISODE_BYTES = 2 * 2**30  # of all chunks, and of all decoded pictures


@dataclass(frozen=True, slots=True)
class Episode:
    """A recorded episode. T control steps, K steps with frames."""

    path: Path
    info: EpisodeInfo
    result: EpisodeResult
    time_s: np.ndarray  # float64 (T,)  simulated, before the action
    state: np.ndarray  # float32 (T, 16)  before the action
    action: np.ndarray  # float32 (T, 16)  clean: what a policy should learn
    executed: np.ndarray  # float32 (T, 16)
    reward: np.ndarray  # float32 (T,)  after the action
    stage: np.ndarray  # int64 (T,)  after the action
    chunks: Mapping[int, np.ndarray]  # step -> float32 (Tp, 16), where the policy replanned
    image_steps: np.ndarray  # int64 (K,)  steps at which every recorded view has a frame
    images: Mapping[str, np.ndarray]  # view -> uint8 (K, H, W, 3); empty if not asked for


@dataclass(frozen=True, slots=True)
class EpisodeIndex:
    """What the end of a recording says about it, without reading the rest."""

    num_bytes: int
    num_steps: int
    num_frames: Mapping[str, int]  # view -> number of frames
    data_crc: int  # CRC-32 of everything recorded


def read_episode(path: str | Path, *, images: bool | Collection[str] = True) -> Episode:
    """The whole episode at `path`, with every checksum verified.

    `images` says which views to decode: all, none, or those named. Raises UserError naming the file where
    it is missing, truncated or corrupt, and where it lacks a view that is asked for.
    """
    path = Path(path)
    data = _read_bytes(path)
    try:
        return _parse(path, data, images)
    except UserError:
        raise
    except Exception as error:  # a damaged byte can surface as anything from EndOfFile to KeyError
        raise _damaged(path, error) from error


def read_index(path: str | Path) -> EpisodeIndex:
    """The counts at the end of a recording. Raises UserError where the file is missing or incomplete."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            summary = SeekingReader(stream, record_size_limit=path.stat().st_size).get_summary()
            records = {record.name for record in summary.metadata_indexes}
            if not {messages.EPISODE_RECORD, messages.RESULT_RECORD} <= records:
                raise ValueError("its first or last record is missing")
            counts = {
                summary.channels[channel].topic: count
                for channel, count in summary.statistics.channel_message_counts.items()
            }
            num_bytes = stream.seek(0, 2)
            footer_length = 1 + 8 + 8 + 8 + 4 + 8  # opcode, length, two offsets, CRC, closing magic
            stream.seek(num_bytes - footer_length + 9)
            summary_start = struct.unpack("<Q", stream.read(8))[0]
            stream.seek(summary_start - _DATA_END.size)
            opcode, _, data_crc = _DATA_END.unpack(stream.read(_DATA_END.size))
            if opcode != _DATA_END_OPCODE:
                raise ValueError("the record before its summary is none of ours")
    except FileNotFoundError as error:
        raise _missing(path) from error
    except Exception as error:  # see read_episode
        raise _damaged(path, error) from error
    cameras = {topic: count for topic, count in counts.items() if topic.startswith(messages.CAMERA)}
    frames = {topic.removeprefix(messages.CAMERA): count for topic, count in cameras.items()}
    return EpisodeIndex(num_bytes, counts.get(messages.STATE, 0), frames, data_crc)


def episode_is_complete(path: str | Path) -> bool:
    """Whether `path` was written to its end. Cheap: checksums are left to `read_episode`."""
    try:
        read_index(path)
    except UserError:
        return False
    return True


def _parse(path: Path, data: bytes, images: bool | Collection[str]) -> Episode:
    topics: dict[int, str] = {}
    rows: dict[str, list[tuple[int, bytes]]] = {}
    metadata: dict[str, dict[str, str]] = {}
    config: dict[str, Any] = {}
    for record in _records(data):
        if isinstance(record, Message):
            rows.setdefault(topics[record.channel_id], []).append((record.log_time, record.data))
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        elif isinstance(record, Attachment) and record.name == messages.CONFIG_ATTACHMENT:
            config = parse_json(record.data)  # read, never written: its name is no path
    for name in (messages.EPISODE_RECORD, messages.RESULT_RECORD):
        if name not in metadata:
            raise ValueError(f"no metadata record {name}")
    if (found := metadata[messages.EPISODE_RECORD]["format"]) != messages.FORMAT:
        raise UserError(
            f"{path} has recording format {found}, wanted {messages.FORMAT}: delete it and collect it again."
        )
    info = messages.read_info(metadata[messages.EPISODE_RECORD], config)
    result = messages.read_result(metadata[messages.RESULT_RECORD])

    times = [time for time, _ in rows.get(messages.STATE, [])]
    num_steps = int(metadata[messages.RESULT_RECORD]["recorded_steps"])
    for topic in (messages.STATE, messages.ACTION, messages.REWARD):
        if len(rows.get(topic, [])) != num_steps:
            raise ValueError(f"{len(rows.get(topic, []))} messages of {topic} for {num_steps} steps")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"times of {messages.STATE} do not increase")
    step_at = {time: step for step, time in enumerate(times)}

    states = [messages.from_arms(parse_json(text)) for _, text in rows.get(messages.STATE, [])]
    actions = [parse_json(text) for _, text in rows.get(messages.ACTION, [])]
    rewards = [parse_json(text) for _, text in rows.get(messages.REWARD, [])]
    chunks = [parse_json(text) for _, text in rows.get(messages.CHUNK, [])]
    frames = {
        topic.removeprefix(messages.CAMERA): {step_at[time]: text for time, text in row}
        for topic, row in rows.items()
        if topic.startswith(messages.CAMERA)
    }
    image_steps = sorted(set.intersection(*(set(steps) for steps in frames.values()))) if frames else []
    views = (tuple(frames) if images else ()) if isinstance(images, bool) else tuple(images)
    if lacking := [view for view in views if view not in frames]:
        raise UserError(
            f"{path} has no frames of view {', '.join(lacking)}; it has {', '.join(frames) or 'none'}. "
            "Change observation.views, or collect again with these views."
        )
    return Episode(
        path=path,
        info=info,
        result=result,
        time_s=(np.array(times, np.int64) - messages.EPOCH_NS) / 1e9,
        state=_matrix(states),
        action=_matrix([messages.from_arms(action["clean"]) for action in actions]),
        executed=_matrix([messages.from_arms(action["executed"]) for action in actions]),
        reward=np.array([reward["reward"] for reward in rewards], np.float32),
        stage=np.array([reward["stage"] for reward in rewards], np.int64),
        chunks={chunk["step"]: _matrix(chunk["actions"]) for chunk in chunks},
        image_steps=np.array(image_steps, np.int64),
        images={
            view: np.stack(list(_decoded(frames[view][step] for step in image_steps)))
            if image_steps
            else np.zeros((0, *info.image_size, 3), np.uint8)
            for view in views
        },
    )


def _records(data: bytes) -> Iterator[McapRecord]:
    """The records of a file, those of chunks unpacked, checksums verified; never more than a chunk in memory.

    Raises ValueError where chunks promise more than an episode can have: a small file can unpack to anything.
    """
    reader = StreamReader(BytesIO(data), emit_chunks=True, validate_crcs=True, record_size_limit=len(data))
    total = 0
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        if record.compression not in ("", "zstd"):
            raise ValueError(f"compression {record.compression!r}, wanted zstd or none")
        size = len(record.data)
        if record.compression == "zstd":
            size = zstandard.get_frame_parameters(record.data).content_size
        total += size
        if size > MAX_CHUNK_BYTES or total > MAX_EPISODE_BYTES:
            raise ValueError(f"chunks that unpack to {total} bytes")
        if size != record.uncompressed_size:
            raise ValueError(f"a chunk of {size} bytes that is said to have {record.uncompressed_size}")
        yield from breakup_chunk(record, validate_crc=True)


def _decoded(encoded: Iterable[bytes]) -> Iterator[np.ndarray]:
    total = 0
    for message in encoded:
        picture = decode(messages.camera_bytes(message))
        total += picture.nbytes
        if total > MAX_EPISODE_BYTES:
            raise ValueError(f"pictures of more than {MAX_EPISODE_BYTES} bytes")
        yield picture


def _matrix(rows: list) -> np.ndarray:
    """float32 (len(rows), 16); None becomes NaN."""
    with np.errstate(over="ignore"):  # what is too large for a float32 is infinite
        numbers = np.array(rows, np.float64).astype(np.float32)
    return numbers.reshape(len(rows), len(messages.ACTION_NAMES))


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise _missing(path) from error


def _missing(path: Path) -> UserError:
    return UserError(f"Recording {path} does not exist: give the path of a recorded .mcap file.")


def _damaged(path: Path, error: Exception) -> UserError:
    reason = f"{type(error).__name__} {error}".strip()
    return UserError(
        f"Recording {path} is truncated or corrupt ({reason}): delete it, then collect or evaluate again."
    )
