"""Damages files in many ways and reads them: only a UserError may be raised, within bounds of time and memory.

python tools/fuzz.py                            # 20,000 files over all readers
python tools/fuzz.py --files 200 --only mcap    # fewer, of one reader
python tools/fuzz.py --only summary --seed 17 --files 1      # reproduces a finding

The readers are those of everything that somebody else may have written: recordings, checkpoints, configs, results, and
the options of a training, which are checked before its first stage. A file is flipped, cut, spliced and stretched as
bytes; JSON is changed as values too, and messages of a recording inside checksums that fit. Prints a line for each
reader and exits with 1 where anything but a UserError was raised, a file took too long, or memory grew beyond its
bound.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import torch
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from imfvla.command.composition import compose
from imfvla.command.rehearsal import checked_options, rehearse
from imfvla.data import FrameStore
from imfvla.errors import UserError
from imfvla.figures.depth_attention import read_depth_attention
from imfvla.nn.pretrained import read_weights
from imfvla.recording import read_episode, read_index
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.episodes import read_episodes
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.runs import evaluations
from imfvla.rollouts.rollout_log import PARTIAL, RolloutLog
from imfvla.sources.mcap import McapSource
from imfvla.storage.files import write_json
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import TrainState, load_state, load_weights, save_state, save_weights
from imfvla.training.logger import read_metrics

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))  # the files to damage are those of the tests
import outside  # noqa: E402
from synthetic import write_demonstrations, write_episode  # noqa: E402
from synthetic_runs import make_run, write_evaluation  # noqa: E402

TINY = (
    "observation.image_size=[32,32]",
    "size.width=32",
    "size.heads=2",
    "size.depth=1",
    "evaluation.nfe=[1]",
)
MAX_SECONDS = 5.0  # of one file, of processor time: other work on the machine does not count
MAX_GROWTH_BYTES = 3 * 2**30  # of memory: what readers allow an episode to unpack to, and room
SIZES = (0, 1, 2, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
TEXTS = (
    "../../../../tmp/escaped",
    "/etc/passwd",
    "${oc.env:HOME}",
    "imfvla.storage.files.os.system",
    "\0",
    "x" * 5000,
    "",
)
NUMBERS = (0, -1, 1e308, -1e308, 10**30, -(10**30), 2**63, 0.5, True, None, float("nan"), float("inf"))


@dataclass(frozen=True)
class Target:
    """A reader and a file that it takes: `read(path of the file)`, with whatever else it needs beside it."""

    path: Path
    read: Callable[[Path], Any]
    mutate: Callable[[bytes, random.Random], bytes]


@dataclass
class Tally:
    """The outcome of reading a reader's damaged files."""

    refused: int = 0
    read: int = 0
    slowest_s: float = 0.0
    failures: list[str] = field(default_factory=list)


class TooSlow(BaseException):
    """Raised by the clock: nothing in a reader may catch it."""


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
    if rng.random() < 0.1:
        return nested(rng.choice((3, 400, 20_000)))
    return rng.choice((*TEXTS, *NUMBERS, [], {}, [value, value], {"a": value}))


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
    lines[place] = dump(mutate_value(json.loads(lines[place]), rng))
    return ("\n".join(lines) + "\n").encode()


def mutate_one_value(data: bytes, rng: random.Random) -> bytes:
    """A value of JSON that stays JSON: what a command line may say."""
    return json.dumps(mutate_value(json.loads(data), rng)).encode()


def check_options(path: Path) -> None:
    """What `imfvla.train` checks before its first stage, in a config that is whole JSON."""
    config = json.loads(path.read_bytes())
    rehearse(config, checked_options(config).evaluation.nfe)


def mutate_yaml(data: bytes, rng: random.Random) -> bytes:
    """Bytes, or malicious YAML in place of a line."""
    if rng.random() < 0.6:
        return mutate_bytes(data, rng)
    lines = data.decode().splitlines()
    bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{new}: &{new} [{','.join(['*' + old] * 9)}]\n" for old, new in pairwise("abcdefghi")
    )
    hurting = (
        bomb, "x: !!python/object/apply:os.system ['true']", "x: 2020-99-99", "x: " + "[" * 3000, "? [a]\n: b",
        "x: 0b" + "1" * 9000, "<<: {a: 1}", "x: !!binary ////", "x: 1:60:60", "- x", "x: *unknown", "x: 9" + "9" * 5000,
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


def make_targets(folder: Path) -> dict[str, Target]:
    """The readers, each with a whole file of its own below `folder`."""
    recording = folder / "episode.mcap"
    write_episode(recording, 7, num_steps=5, views=("front", "top"), image_size=(16, 16))
    model = torch.nn.Linear(3, 2)
    state = TrainState(model, torch.nn.Linear(3, 2), torch.optim.AdamW(model.parameters()))
    model(torch.ones(1, 3)).sum().backward()
    state.optimiser.step()
    details = {
        "step": 3,
        "train_s": 1.5,
        "precision": "fp32",
        "batches": {"next_batch": 3},
        "logger": {"sums": {}},
    }
    save_state(folder / "state.safetensors", state, details)
    save_weights(folder / "step-3", model, {"step": 3})
    run = RunDirectory(make_run(folder / "run", "socket_ph32_exec16"))
    run.write_status("running", phase="training")
    rollouts = write_evaluation(run.path, 1, number=3)
    seeds = range(100_000, 100_003)
    partial = RolloutLog(folder / "partial", {"nfe": 1})
    with partial:
        for line in (rollouts / "episodes.jsonl").read_text(encoding="utf-8").splitlines():
            partial.append(json.loads(line))
    depth = folder / "depth_attention.json"
    weights = {"actions": [[1.0], [0.5, 0.5]], "context": []}
    write_json(depth, {"experiment": "x", "checkpoint_step": 3, **weights})
    store = folder / "store"
    demos = write_demonstrations(folder / "demos", num_episodes=2, num_steps=4)
    FrameStore.build(McapSource.of(demos), store, (16, 16), ("front",))
    options = folder / "options.json"
    write_json(options, compose("train", TINY))
    tables = folder / "tables.yaml"
    tables.write_bytes((ROOT / "experiments" / "tables.yaml").read_bytes())

    def in_run(read: Callable[[RunDirectory], Any]) -> Callable[[Path], Any]:
        return lambda path: read(run)

    def reopen(path: Path) -> None:
        with RolloutLog(path.parent, {"nfe": 1}) as log:
            [row["seed"] for row in log.rows]

    def report(run: RunDirectory) -> list[Any]:
        return [(one.is_reporting, one.seeds, one.label) for one in evaluations(run)]

    saved, kept = folder / "state.safetensors", folder / "step-3" / "policy.safetensors"
    readers = {
        "mcap": (recording, read_episode, mutate_recording),
        "mcap_index": (recording, read_index, mutate_recording),
        "state": (saved, lambda path: load_state(path, state), mutate_safetensors),
        "weights": (kept, lambda path: load_weights(model, path), mutate_safetensors),
        "pretrained": (kept, lambda path: read_weights(path, "encoder"), mutate_safetensors),
        "config": (run.path / "config.yaml", in_run(RunDirectory.config), mutate_yaml),
        "status": (run.path / "status.json", in_run(RunDirectory.status), mutate_json),
        "summary": (rollouts / "summary.json", in_run(report), mutate_json),
        "episodes": (rollouts / "episodes.jsonl", lambda path: read_episodes(path, seeds), mutate_json),
        "partial": (folder / "partial" / PARTIAL, reopen, mutate_json),
        "metrics": (run.metrics, read_metrics, mutate_json),
        "curve": (run.metrics, in_run(lambda run: learning_curve(run.path)), mutate_json),
        "depth_attention": (depth, lambda path: read_depth_attention(path.parent), mutate_json),
        "store_meta": (store / "meta.json", lambda path: FrameStore.open(path.parent), mutate_json),
        "store_array": (store / "state.npy", lambda path: FrameStore.open(path.parent), mutate_bytes),
        "options": (options, check_options, mutate_one_value),
        "tables": (tables, read_mapping.__wrapped__, mutate_yaml),
    }
    return {name: Target(*reader) for name, reader in (readers | outside_readers(folder / "outside")).items()}


def outside_readers(folder: Path) -> dict[str, tuple[Path, Callable[[Path], Any], Callable[..., bytes]]]:
    """The readers of data from outside whose extras are installed."""
    readers = {}
    with suppress(UserError):  # without pyarrow
        from imfvla.sources import lerobot

        whole = folder / "lerobot"
        with lerobot.LeRobotWriter(whole, outside.ROBOT, pictures="h264") as writer:
            writer.add(outside.episode(0))
        (whole / "meta" / "imfvla_robot.json").unlink()  # so that the statistics are read

        def open_lerobot(path: Path) -> None:
            source = lerobot.open_source(outside.options("lerobot", path=str(whole)))
            source.episode(0, ("front",))

        files = {"info": "meta/info.json", "stats": "meta/stats.json", "tasks": "meta/tasks.parquet"}
        files |= {
            "data": "data/chunk-000/file-000.parquet",
            "rows": "meta/episodes/chunk-000/file-000.parquet",
        }
        files["video"] = "videos/observation.images.front/chunk-000/file-000.mp4"
        for name, file in files.items():
            mutate = mutate_json if file.endswith(".json") else mutate_bytes
            readers[f"lerobot_{name}"] = (whole / file, open_lerobot, mutate)
    with suppress(UserError):  # without mcap-ros2-support
        from bags import write_bag

        from imfvla.sources import ros2

        joints = [{"topic": "/joint_states", "channels": {"elbow": "elbow [rad]"}}]
        given = {"control_hz": 20, "state": joints, "cameras": {"front": "/camera"}, "instruction": "go"}

        def open_bag(path: Path) -> None:
            ros2.open_source(outside.options("ros2", path=str(path)) | given).episode(0, ("front",))

        readers["ros2"] = (write_bag(folder / "bag.mcap", end_s=0.5), open_bag, mutate_bytes)
    with suppress(UserError):  # without h5py
        from imfvla.sources import hdf5

        lift = {"layout": "robomimic", "control_hz": 20, "instruction": "lift"}
        lift |= {"state": outside.EEF_STATE, "action": outside.EEF_ACTION}

        def open_hdf5(path: Path) -> None:
            hdf5.open_source(outside.options("hdf5", path=str(path)) | lift).episode(0, ("agentview_image",))

        readers["hdf5"] = (outside.write_robomimic(folder / "demo.hdf5", (0,)), open_hdf5, mutate_bytes)
    return readers


def fuzz(target: Target, num_files: int, first_seed: int) -> Tally:
    """Reads `num_files` damaged copies, those of the seeds from `first_seed` on; leaves the file as it was."""
    whole = target.path.read_bytes()
    tally = Tally()
    previous = signal.signal(signal.SIGPROF, _raise_too_slow)
    try:
        for seed in range(first_seed, first_seed + num_files):
            target.path.parent.mkdir(exist_ok=True)
            target.path.write_bytes(target.mutate(whole, random.Random(seed)))
            began = time.process_time()
            try:
                signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
                target.read(target.path)
                tally.read += 1
            except UserError:
                tally.refused += 1
            except (Exception, TooSlow):
                tally.failures.append(f"seed {seed}: {traceback.format_exc(limit=-3)}")
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
            tally.slowest_s = max(tally.slowest_s, time.process_time() - began)
    finally:
        signal.signal(signal.SIGPROF, previous)
        target.path.parent.mkdir(exist_ok=True)
        target.path.write_bytes(whole)
    return tally


def _raise_too_slow(*_: object) -> None:
    raise TooSlow(f"more than {MAX_SECONDS} s")


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--files", type=int, default=20_000, help="over all readers")
    parser.add_argument("--seed", type=int, default=0, help="of the first file of each reader")
    parser.add_argument("--only", action="append", help="only these readers")
    parser.add_argument("--summary", type=Path, help="write the figures here too, as JSON")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    failed, rows = 0, {}
    with tempfile.TemporaryDirectory(prefix="imfvla-fuzz-") as folder:
        targets = make_targets(Path(folder))
        if unknown := set(options.only or ()) - targets.keys():
            parser.error(f"no reader {', '.join(unknown)}; there are {', '.join(targets)}")
        chosen = {name: target for name, target in targets.items() if name in (options.only or targets)}
        before = psutil.Process().memory_info().rss
        limit = psutil.Process().memory_info().vms + MAX_GROWTH_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for name, target in chosen.items():
            tally = fuzz(target, -(-options.files // len(chosen)), options.seed)
            failed += len(tally.failures)
            counts = {"refused": tally.refused, "read": tally.read, "failures": len(tally.failures)}
            rows[name] = counts | {"slowest_s": round(tally.slowest_s, 3)}
            print(name, *(f"{key} {value}" for key, value in rows[name].items()), sep="  ", flush=True)
            for failure in tally.failures[:3]:
                print(failure, flush=True)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    total = sum(row["refused"] + row["read"] + row["failures"] for row in rows.values())
    print(f"{total} files, {failed} failures, memory grew by at most {grown / 2**20:.0f} MiB")
    if options.summary:
        figures = {"files": total, "failures": failed, "grown_mib": round(grown / 2**20), "readers": rows}
        options.summary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 1 if failed or grown > MAX_GROWTH_BYTES else 0


if __name__ == "__main__":
    sys.exit(main())
