"""The files that work leaves in its folder, compared with those of undisturbed work."""

import json
from pathlib import Path
from typing import Any

import torch

from imfvla.recording import read_episode
from imfvla.reporting.rows import untimed
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import read_metrics
from imfvla.training.tensor_files import read_tensors

TIMES = {"steps_per_s", "data_wait_fraction", "train_s"}
NOT_OF_WORK = {"train_s", "code", "earlier_code"}  # of a state's header: somebody may commit in the meantime


class Differs(Exception):
    """The outcome differs from that of an undisturbed run."""


def state_of(folder: Path) -> dict[str, Any]:
    """Everything that a training leaves, except times."""
    run = RunDirectory(folder)
    files = {"state": run.last_state} | {f"step {s}": run.policy_weights(s) for s in run.weight_steps()}
    found: dict[str, Any] = {}
    for name, path in files.items():
        tensors, header = read_tensors(path)
        found |= {f"{name}: {key}": tensor for key, tensor in tensors.items()}
        details = json.loads(header.get("details", "{}"))
        found[f"{name}: header"] = {key: details[key] for key in details.keys() - NOT_OF_WORK}
    rows = read_metrics(run.metrics)
    found["metrics"] = [{key: value for key, value in row.items() if key not in TIMES} for row in rows]
    return found


def rows_of(folder: Path) -> dict[str, Any]:
    """Everything that evaluations leave, except times."""
    found: dict[str, Any] = {}
    for rollouts in sorted((folder / "rollouts").iterdir()):
        rows = [
            json.loads(line)
            for line in (rollouts / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
        ]
        summary = json.loads((rollouts / "summary.json").read_text(encoding="utf-8"))
        same = ("success_episodes", "avg_return", "recordings", "protocol", "episodes", "failures")
        found[f"{rollouts.name} rows"] = [untimed(row) for row in rows]
        found[f"{rollouts.name} summary"] = [summary[key] for key in same]
        for path in rollouts.glob("*.mcap"):
            found[f"{rollouts.name} {path.name}"] = torch.from_numpy(read_episode(path).executed)
    return found


def demonstrations_of(folder: Path) -> dict[str, Any]:
    """Everything that a collection leaves: content of recordings, seeds that failed, no other file."""
    found: dict[str, Any] = {}
    for path in sorted(file for file in folder.rglob("*") if file.is_file()):
        if path.suffix == ".mcap":
            episode = read_episode(path)
            found |= {
                f"{path.name} {key}": torch.from_numpy(getattr(episode, key)) for key in ("state", "action")
            }
            found |= {
                f"{path.name} {view}": torch.from_numpy(images) for view, images in episode.images.items()
            }
        elif path.suffix != ".part":  # left by a kill; overwritten when its seed is played
            found[path.name] = path.read_text(encoding="utf-8")
    return found


def compare(found: dict[str, Any], wanted: dict[str, Any]) -> int:
    """The number of equal parts. Raises Differs naming those that are not equal bit for bit."""
    different = sorted(found.keys() ^ wanted.keys())
    for name in found.keys() & wanted.keys():
        one, other = found[name], wanted[name]
        equal = torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
        different += [] if equal else [name]
    if different:
        raise Differs(f"{len(different)} of {len(wanted)} parts differ: {', '.join(different[:6])}")
    return len(wanted)
