"""Ways to damage a file: as bytes, or as the values that it holds, so that it still parses."""

import json
import random
from io import BytesIO
from itertools import pairwise
from typing import Any

import yaml
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

SIZES = (0, 1, 2, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
TEXTS = (
    "../../../../tmp/escaped",
    "/etc/passwd",
    "${oc.env:HOME}",
    "imfvla.files.os.system",
    "\0",
    "x" * 5000,
    "",
    "12",
    "true",
    r"$\frac{ $",
    "a\nb",
    "\x1b[31m",
    "_",
)
NUMBERS = (
    *(0, -1, 5, 10**6, 1e308, -1e308, 1e-320, 10**30, -(10**30), 10**400, 2**31, 2**63),
    *(0.5, True, None, float("nan"), float("inf")),
)


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to four changes of bytes."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(changed) + 1)
        length = rng.choice((1, 2, 4, 8, rng.randint(1, 64), rng.randint(1, max(1, len(changed)))))
        match rng.randrange(7):
            case 0 if place < len(changed):
                changed[place] ^= 1 << rng.randrange(8)
            case 1:
                del changed[place:]
            case 2:
                del changed[place : place + length]
            case 3:
                changed[place:place] = changed[place : place + length]
            case 4:
                changed[place:place] = rng.randbytes(min(length, 64))
            case 5:
                width = rng.choice((1, 2, 4, 8))
                number = rng.choice(SIZES) % 256**width
                changed[place : place + width] = number.to_bytes(width, rng.choice(("little", "big")))
            case _:
                other = rng.randrange(len(changed) + 1)
                changed[place : place + length] = changed[other : other + length]
    return bytes(changed)


def mutate_value(value: Any, rng: random.Random) -> Any:
    """A value with one part, however deep, replaced, removed, doubled or nested."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(sorted(value))
        if rng.random() < 0.1:
            return {name: item for name, item in value.items() if name != key}
        return value | {key: mutate_value(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.7:
        place = rng.randrange(len(value))
        if rng.random() < 0.1:
            return value[:place] + value[place + 1 :]
        return value[:place] + [mutate_value(value[place], rng)] + value[place + 1 :]
    chance = rng.random()
    if chance < 0.05:
        return nested(rng.choice((3, 400, 20_000)))
    if chance < 0.1:
        return [value] * rng.choice((2, 300, 3000))
    if chance < 0.4:  # nearly the same
        return rng.choice(near(value))
    return rng.choice((*TEXTS, *NUMBERS, [], {}, [value, value], {"a": value}))


def near(value: Any) -> list[Any]:
    """Values that a careless reader takes for `value`."""
    others: list[Any] = [str(value), [value], {"": value}, None]
    if isinstance(value, int | float):
        others += [-value, value + 1, value * 10**9, float(value), bool(value), value / 3]
    if isinstance(value, str):
        others += [value + " ", value[1:], [*value], value.upper()]
    if isinstance(value, list):
        others += [value[::-1], value[1:], [str(item) for item in value], dict(enumerate(value))]
    if isinstance(value, dict):
        others += [[*value], [*value.items()], {key.upper(): item for key, item in value.items()}]
    return others


def nested(depth: int) -> "Raw":
    """JSON of so many nested lists."""
    return Raw("[" * depth + "]" * depth)


class Raw(str):
    """JSON that `dump` writes as it is."""


def dump(value: Any) -> str:
    """JSON, with `Raw` parts as they are."""
    raws: list[str] = []

    def stand_in(item: Any) -> Any:
        if isinstance(item, Raw):
            raws.append(item)
            return f"@raw{len(raws) - 1}@"
        if isinstance(item, dict):
            return {key: stand_in(part) for key, part in item.items()}
        return [stand_in(part) for part in item] if isinstance(item, list) else item

    text = json.dumps(stand_in(value))
    for number, raw in enumerate(raws):
        text = text.replace(f'"@raw{number}@"', raw)
    return text


def mutate_json(data: bytes, rng: random.Random) -> bytes:
    """Bytes or a value of one line of JSON, or of the whole where there is one value."""
    if rng.random() < 0.4:
        return mutate_bytes(data, rng)
    text = data.decode()
    lines = text.splitlines() if text.count("\n{") else [text]
    place = rng.randrange(len(lines))
    if len(lines) > 1 and rng.random() < 0.1:  # a line twice, or away, or all alike in one key
        return mutate_lines(lines, place, rng)
    lines[place] = dump(mutate_value(json.loads(lines[place]), rng))
    return ("\n".join(lines) + "\n").encode()


def mutate_lines(lines: list[str], place: int, rng: random.Random) -> bytes:
    """A line doubled, removed or moved, or one key of all lines with one value."""
    match rng.randrange(4):
        case 0:
            lines.insert(place, lines[place])
        case 1:
            del lines[place]
        case 2:
            rng.shuffle(lines)
        case _:
            rows = [json.loads(line) for line in lines]
            key = rng.choice(sorted(rows[place]))
            value = mutate_value(rows[place][key], rng)
            lines = [dump(row | {key: value}) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def mutate_one_value(data: bytes, rng: random.Random) -> bytes:
    """A value of JSON that stays JSON: what a command line may say."""
    return json.dumps(mutate_value(json.loads(data), rng)).encode()


def mutate_yaml(data: bytes, rng: random.Random) -> bytes:
    """Bytes, a value, or malicious YAML in place of a line."""
    chance = rng.random()
    if chance < 0.3:
        return mutate_bytes(data, rng)
    if chance < 0.8:
        return dump(mutate_value(yaml.safe_load(data), rng)).encode()
    lines = data.decode().splitlines()
    bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{new}: &{new} [{','.join(['*' + old] * 9)}]\n" for old, new in pairwise("abcdefghi")
    )
    hurting = (
        bomb, "x: !!python/object/apply:os.system ['true']", "x: 2020-99-99", "x: " + "[" * 3000, "? [a]\n: b",
        "x: 0b" + "1" * 9000, "<<: {a: 1}", "x: !!binary ////", "x: 1:60:60", "- x", "x: *unknown", "x: 9" + "9" * 5000,
        "x: {" + "a," * 100_000 + "}", "x: .nan", "x: 2020-01-01", "1: x", "null: x", "x: !!set {a, b}",
    )  # fmt: skip
    lines[rng.randrange(len(lines))] = rng.choice(hurting)
    return ("\n".join(lines) + "\n").encode()


def mutate_safetensors(data: bytes, rng: random.Random) -> bytes:
    """Bytes, or values of the header with its length put right."""
    if rng.random() < 0.5:
        return mutate_bytes(data, rng)
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    metadata = header.get("__metadata__", {})
    if "details" in metadata and rng.random() < 0.5:
        metadata["details"] = dump(mutate_value(json.loads(metadata["details"]), rng))
        changed = dump(header).encode()
    else:
        changed = dump(mutate_value(header, rng)).encode()
    return len(changed).to_bytes(8, "little") + changed + data[8 + length :]


def mutate_recording(data: bytes, rng: random.Random) -> bytes:
    """Bytes anywhere, or one message, metadata record or attachment inside checksums that fit."""
    if rng.random() < 0.4:
        return mutate_bytes(data, rng)
    records = list(StreamReader(BytesIO(data)).records)
    kinds = (Message, Metadata, Attachment, Channel)
    chosen = rng.choice([record for record in records if isinstance(record, kinds)])
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True)
    writer.start(profile="", library="fuzz")
    channels: dict[int, int] = {}
    for record in records:
        is_chosen = record is chosen
        if isinstance(record, Channel) and record.id not in channels:
            topic = rng.choice(TEXTS) if is_chosen else record.topic
            channels[record.id] = writer.register_channel(topic, "json", 0)
        elif isinstance(record, Message):
            time_ns = rng.choice(SIZES) if is_chosen and rng.random() < 0.1 else record.log_time
            data = mutate_json(record.data, rng) if is_chosen else record.data
            writer.add_message(channels[record.channel_id], time_ns, data, time_ns)
        elif isinstance(record, Metadata):
            fields = dict(record.metadata)
            if is_chosen:
                name = rng.choice(sorted(fields))
                fields[name] = mutate_json(fields[name].encode(), rng).decode(errors="replace")
            writer.add_metadata(record.name, fields)
        elif isinstance(record, Attachment):
            name = rng.choice(TEXTS) if is_chosen and rng.random() < 0.3 else record.name
            data = mutate_json(record.data, rng) if is_chosen else record.data
            writer.add_attachment(0, 0, name, record.media_type, data)
    writer.finish()
    return stream.getvalue()
