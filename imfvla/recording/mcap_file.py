"""The records of an MCAP file, whatever library wrote it, and whether a file is cut off."""

import errno
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk

from imfvla.errors import UserError
from imfvla.storage.opening import DATA, open_to_read, size_of

MAGIC = b"\x89MCAP0\r\n"  # at both ends of a file
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
FOOTER_SIZE = RECORD_HEAD.size + 8 + 8 + 4  # two offsets and a CRC
DATA_END_SIZE = RECORD_HEAD.size + 4  # a CRC
MAX_CHUNK_BYTES = 256 * 2**20  # of one chunk, unpacked; ours have 1 MiB
MAX_EPISODE_BYTES = 2 * 2**30  # of all chunks, and of all decoded pictures


class TruncatedRecording(UserError):
    """A recording that ends before its end."""


class ForeignRecording(ValueError):
    """A whole MCAP file of another program; the text says what it lacks."""


def records(data: bytes) -> Iterator[McapRecord]:
    """The records of a file, chunks unpacked and checksums verified; at most one chunk is in memory.

    Raises ValueError where chunks state more bytes than an episode can have: a small file can unpack to any size.
    """
    return streamed_records(BytesIO(data), len(data), MAX_EPISODE_BYTES)


def streamed_records(stream: IO[bytes], size: int, most: int) -> Iterator[McapRecord]:
    """`records` of an open file of `size` bytes whose chunks may unpack to `most` bytes in all."""
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size)
    total = 0
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        total += record.uncompressed_size
        if record.uncompressed_size > MAX_CHUNK_BYTES or total > most:
            raise ValueError(f"chunks that unpack to {total} bytes")
        yield from breakup_chunk(replace(record, compression="", data=_unpacked(record)), validate_crc=True)


def _unpacked(chunk: Chunk) -> bytes:
    """The content of a chunk, which must have the size that its record states: a frame need not say its own."""
    most = chunk.uncompressed_size + 1  # one byte more than stated reveals a longer content
    if chunk.compression == "zstd":
        content = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True).read(most)
    elif chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    elif chunk.compression == "":
        content = chunk.data
    else:
        raise NotImplementedError(f"a chunk of compression {chunk.compression!r}, wanted zstd, lz4 or none")
    if len(content) != chunk.uncompressed_size:
        found = f"{len(content)}" if len(content) < most else "more"
        raise ValueError(f"a chunk of {found} bytes that states {chunk.uncompressed_size}")
    return content


def missing_end(path: Path) -> str | None:
    """What a cut-off file lacks: "data end" or "footer". None where it ends as MCAP files do, or is no MCAP file.

    It follows lengths and reads no contents, so a damaged file is not taken for a cut-off one.
    """
    with open_to_read(path, DATA) as stream:
        size = size_of(stream)
        start = stream.read(len(MAGIC))
        if not MAGIC.startswith(start):
            return None
        if size >= 2 * len(MAGIC):
            stream.seek(-len(MAGIC), 2)
            if stream.read() == MAGIC:
                return None
        place = len(MAGIC)
        while place + RECORD_HEAD.size <= size:
            stream.seek(place)
            opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
            if opcode == 0:  # no record has it: zeros left by a file system
                return None
            place += RECORD_HEAD.size + length
            if opcode == Opcode.DATA_END and place <= size:
                return "footer"
    return "data end"


@contextmanager
def clear_read_errors(path: Path) -> Iterator[None]:
    """Turns errors of reading a recording into a UserError that says what was found.

    It advises deletion only where the data itself is cut off.
    """
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(
            f"Recording {path} does not exist: give the path of a recorded .mcap file."
        ) from error
    except NotImplementedError as error:
        raise UserError(
            f"Recording {path} has {error} (others are not supported): rewrite it with `mcap compress`, or restore it "
            "from a copy."
        ) from error
    except Exception as error:  # a damaged byte can raise anything from EndOfFile to KeyError
        # EINVAL comes from a damaged offset.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            reason = error.strerror or error
            raise UserError(
                f"Recording {path} cannot be read: {reason}; check the path and its permissions."
            ) from error
        if (missing := missing_end(path)) == "data end":
            raise TruncatedRecording(
                f"Recording {path} is truncated (its data end record is missing): delete it, "
                "then collect or evaluate again."
            ) from error
        if missing:
            raise TruncatedRecording(
                f"Recording {path} is truncated after its data, which may be complete: copy it again, or "
                "rewrite it with `mcap recover`."
            ) from error
        if isinstance(error, ForeignRecording):
            raise UserError(
                f"Recording {path} is no episode of imfvla: it must have {error}, found none. Bags of ROS 2 are read "
                "with demos=ros2; move other files to another folder."
            ) from error
        reason = f"{type(error).__name__} {error}".strip()
        raise UserError(
            f"Recording {path} is damaged or not an episode of imfvla ({reason}): restore it from a copy, or move it "
            "away and collect or evaluate again."
        ) from error


def misplaced_end(data: bytes) -> str | None:
    """What is wrong with the end of a file whose records are whole: bytes behind it, or an index that is elsewhere."""
    place, data_end = len(MAGIC), 0
    while place + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        end = place + RECORD_HEAD.size + length
        if opcode == Opcode.DATA_END:
            data_end = end
        elif opcode == Opcode.FOOTER:
            if behind := len(data) - end - len(MAGIC):
                return f"{behind} bytes are behind its end"
            (stated,) = struct.unpack_from("<Q", data, place + RECORD_HEAD.size)
            wanted = 0 if data_end == place else data_end  # 0 where there is no index
            return (
                None if stated == wanted else f"its index begins at byte {wanted}, its footer says {stated}"
            )
        place = end
    return "it has no footer"
