"""ROS 2 bags in MCAP: which files belong together, and their messages, decoded where they are wanted."""

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema

from imfvla.errors import UserError
from imfvla.recording.mcap_file import missing_end, streamed_records
from imfvla.sources.checks import misfit, missing_extra, read_errors_told, shortened
from imfvla.storage.opening import ANYWHERE, DATA, open_to_read, real_path, size_of

try:
    from mcap_ros2.decoder import DecoderFactory
except ImportError as error:
    raise missing_extra("ros2", error) from error

METADATA = "metadata.yaml"
MAX_BAG_BYTES = 256 * 2**30  # of one file, unpacked
COPY = "copy the bag again, or rewrite it with `mcap recover`"


@dataclass(frozen=True, slots=True)
class Bag:
    """The files of one recording, in their order."""

    name: str
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class Received:
    """A message with what is needed to decode it."""

    topic: str
    kind: str  # such as "sensor_msgs/msg/JointState"
    log_time: int  # [ns]
    data: bytes
    file: Path
    _schema: Schema
    _factory: DecoderFactory

    def decode(self) -> Any:
        """Its fields as attributes."""
        with clear_errors(self.file):
            return self._factory.decoder_for("cdr", self._schema)(self.data)

    def stamp(self) -> int:
        """header.stamp [ns] of a message that begins with a header or a time, read without decoding the rest."""
        order = "little" if self.data[1:2] == b"\1" else "big"
        seconds = int.from_bytes(self.data[4:8], order, signed=True)
        return seconds * 10**9 + int.from_bytes(self.data[8:12], order)


def find_bags(paths: Sequence[str], where: str) -> list[Bag]:
    """The bags at these paths: a file, the folder of one bag, or a folder of files and bags; one episode each or more.

    Raises UserError where there are none, or only some that are not supported.
    """
    found = [bag for path in map(Path, paths) for bag in _bags_at(path)]
    if not found:
        raise UserError(
            f"{where}.path must hold ROS 2 bags (*.mcap), found none in {', '.join(map(str, paths))}: correct it."
        )
    return found


def _bags_at(path: Path) -> list[Bag]:
    if path.is_file():
        return [Bag(path.stem, (_supported(path),))]
    if not path.is_dir():
        raise UserError(f"There is no bag {path}: give the path of a .mcap file or of a bag's folder.")
    entries = sorted(path.iterdir(), key=lambda entry: _natural(entry.name))
    for entry in entries:
        real_path(entry)
    files = [
        _supported(entry) for entry in entries if entry.is_file() and re.search(r"\.(mcap|db3)\b", entry.name)
    ]
    if (path / METADATA).exists():
        if not files:
            raise UserError(f"{path} must hold *.mcap beside its {METADATA}, found none: copy the bag again.")
        return [Bag(path.name, tuple(files))]
    folders = [entry for entry in entries if entry.is_dir() and (entry / METADATA).exists()]
    return [Bag(file.stem, (file,)) for file in files] + [
        bag for folder in folders for bag in _bags_at(folder)
    ]


def _supported(path: Path) -> Path:
    if path.name.endswith(".mcap"):
        return path
    remedy = f"unpack it first: zstd -d {path.name}"
    if ".db3" in path.name:
        remedy = "convert it first: ros2 bag convert, with storage_id: mcap"
    elif not path.name.endswith(".mcap.zstd"):
        remedy = "give the path of a .mcap file or of a bag's folder"
    raise UserError(f"{path} must be a .mcap file (other bags are not supported); {remedy}.")


def _natural(name: str) -> list[tuple[int, str]]:
    """name_2 before name_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def received(bag: Bag, topics: Collection[str]) -> Iterator[Received]:
    """The messages of these topics in the order of the files. Raises UserError where one is damaged or not ROS 2's."""
    for path in bag.files:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        factory = DecoderFactory()
        with clear_errors(path), open_to_read(path, DATA, home=ANYWHERE) as stream:
            for record in streamed_records(stream, size_of(stream), MAX_BAG_BYTES):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                    if record.topic in topics:
                        _check_channel(record, schemas.get(record.schema_id), path)
                elif isinstance(record, Message) and channels[record.channel_id].topic in topics:
                    channel = channels[record.channel_id]
                    schema = schemas[channel.schema_id]
                    yield Received(
                        channel.topic, schema.name, record.log_time, record.data, path, schema, factory
                    )


def topics_of(bag: Bag) -> dict[str, str]:
    """Topic -> type of all messages, for messages to the user."""
    found: dict[str, str] = {}
    for path in bag.files:
        schemas: dict[int, str] = {}
        with clear_errors(path), open_to_read(path, DATA, home=ANYWHERE) as stream:
            for record in streamed_records(stream, size_of(stream), MAX_BAG_BYTES):
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    found[record.topic] = schemas.get(record.schema_id, "?")
    return found


def _check_channel(channel: Channel, schema: Schema | None, path: Path) -> None:
    encoding = schema.encoding if schema else "none"
    if (channel.message_encoding, encoding) != ("cdr", "ros2msg"):
        raise misfit(
            path,
            f"topic {channel.topic}",
            "of ROS 2 (cdr with a ros2msg schema; other encodings are not supported)",
            f"{channel.message_encoding} with {encoding}",
            "record it with ros2 bag",
        )


def clear_errors(path: Path) -> AbstractContextManager[None]:
    """Turns what damaged bytes raise, which can be anything, into a UserError."""
    return read_errors_told(
        path,
        "a bag",
        "copy the bag again",
        lambda error: f"has what is not supported: {error}; leave this topic out, or rewrite the bag.",
        lambda error: f"must be a whole MCAP file of ROS 2, found it {_damage(path, error)}; {COPY}.",
        (Exception,),
    )


def _damage(path: Path, error: Exception) -> str:
    cut = missing_end(path)
    return f"cut off, without its {cut}" if cut else shortened(f"{type(error).__name__} {error}".strip())
