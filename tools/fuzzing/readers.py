"""The readers of everything that somebody else may have written, each with a whole file of its own."""

import json
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import outside
import torch
from synthetic import write_demonstrations, write_episode
from synthetic_runs import make_run, write_evaluation

from fuzzing.mutations import (
    mutate_bytes,
    mutate_json,
    mutate_one_value,
    mutate_recording,
    mutate_safetensors,
    mutate_yaml,
)  # fmt: skip
from imfvla.command.composition import compose
from imfvla.command.rehearsal import checked_options, rehearse
from imfvla.config.protocol import Protocol
from imfvla.data import FrameStore
from imfvla.errors import UserError
from imfvla.figures.depth_attention import read_depth_attention
from imfvla.modes.recordings import choose_recordings
from imfvla.nn.pretrained import read_weights
from imfvla.recording import read_episode, read_index
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.episodes import read_episodes
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.runs import evaluations
from imfvla.reporting.shipping import command_of, provenance
from imfvla.rollouts.latency import FILE as LATENCY
from imfvla.rollouts.latency import latency_of
from imfvla.rollouts.rollout_log import PARTIAL, RolloutLog
from imfvla.sources.collection import LOG_NAME, recording_path
from imfvla.sources.mcap import McapSource
from imfvla.storage.files import write_json
from imfvla.storage.fingerprint import fingerprint
from imfvla.storage.metrics import read_metrics
from imfvla.storage.run_directory import OVERRIDES, RunDirectory
from imfvla.storage.trained_config import refuse_changed_config, trained_data
from imfvla.training.checkpoint import load_weights, save_weights
from imfvla.training.train_state import TrainState, load_state, save_state

SLOW = {"config", "options", "tables"}  # YAML, and a policy that is built
QUICK = 16
ROOT = Path(__file__).resolve().parents[2]
PROTOCOL = Protocol("fake", "default", 3, "0" * 16, 1, 0, 1.0, 100_000, 3, None, "cpu")
TINY = (
    "observation.image_size=[32,32]",
    "size.width=32",
    "size.heads=2",
    "size.depth=1",
    "evaluation.nfe=[1]",
)


@dataclass(frozen=True)
class Target:
    """A reader and a file that it takes: `read(path of the file)`, with whatever else it needs beside it."""

    path: Path
    read: Callable[[Path], Any]
    mutate: Callable[[bytes, random.Random], bytes]
    share: int = 1  # of the files: more where one takes a millisecond


def check_options(path: Path) -> None:
    """What `imfvla.train` checks before its first stage, in a config that is whole JSON."""
    config = json.loads(path.read_bytes())
    rehearse(config, checked_options(config).evaluation)


def make_readers(folder: Path) -> dict[str, Target]:
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
        "gradient_scale": None,
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
        partial.begin()
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

    latencies = run.path / LATENCY
    taken = {"median_ms": 5.0, "p95_ms": 6.0, "calls": 20, "at": "2026-11-28T00:00:00+00:00", "load": 1.0}
    latency_of(run, PROTOCOL, lambda: taken)
    described = run.weights_directory(3)
    save_weights(
        described, model, {"step": 3, "train_s": 1.0, "fingerprint": fingerprint(), "config": run.config()}
    )
    run.keep_overrides(["+exp=socket_ph32_exec16", "seed=1"])
    write_json(folder / "collected" / LOG_NAME, {"settings": {}, "failed_seeds": [1, 2]})
    for seed in (0, 3, 5):
        recording_path(folder / "collected", seed).touch()
    demos = {"demos": {"first_seed": 0, "episodes": 2}}

    def made_by(run: RunDirectory) -> None:
        refuse_changed_config(run, run.config(), 3)
        trained_data(run, 3)
        provenance(run, described / "policy.safetensors", [])

    def in_run(read: Callable[[RunDirectory], Any]) -> Callable[[Path], Any]:
        return lambda path: read(run)

    def reopen(path: Path) -> None:
        with RolloutLog(path.parent, {"nfe": 1}) as log:
            log.begin()
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
        "latency": (latencies, in_run(lambda run: latency_of(run, PROTOCOL, lambda: taken)), mutate_json),
        "made_by": (described / "policy.json", in_run(made_by), mutate_json),
        "overrides": (run.path / OVERRIDES, in_run(lambda run: command_of(run, {"name": "x"})), mutate_json),
        "collected": (
            folder / "collected" / LOG_NAME,
            lambda path: choose_recordings(demos, path.parent, None, 2),
            mutate_json,
        ),
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
    ours = {name: Target(*reader, share=1 if name in SLOW else QUICK) for name, reader in readers.items()}
    return ours | {name: Target(*reader) for name, reader in outside_readers(folder / "outside").items()}


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
        named = folder / "named"
        with lerobot.LeRobotWriter(named, outside.ROBOT, pictures="png") as writer:
            writer.add(outside.episode(0))

        def open_named(path: Path) -> None:
            lerobot.open_source(outside.options("lerobot", path=str(named))).episode(0, ("front",))

        readers["lerobot_robot"] = (named / "meta" / "imfvla_robot.json", open_named, mutate_json)
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
