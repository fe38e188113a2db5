"""Exports a run's policy: a folder with the graphs and a card for each number of evaluations, whole or not at all."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from imfvla.deployment.graphs import policy_graphs
from imfvla.deployment.parity import TOLERANCE, largest_difference, latencies, observations
from imfvla.policy import Policy
from imfvla.policy.blank import blank_observation
from imfvla.process.progress import Progress
from imfvla.reporting.table import Table, number
from imfvla.runtime.graphs import FORMAT, digest_of_graph
from imfvla.runtime.onnx_policy import OnnxPolicy
from imfvla.storage.files import (
    clear_write_errors,
    locked,
    make_folder,
    put_folder,
    refuse_existing,
    write_json,
)
from imfvla.storage.fingerprint import fingerprint
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.trained_config import digest_of_config
from imfvla.training.checkpoint import load_policy

EXISTING = "remove it, or name another folder with output=DIR"
INPUTS = {
    "images": "uint8, one picture of each of `views` at each observed step",
    "state": "float32, the state channels of `robot`, in its units",
    "instruction": "int64, word ids as imfvla.types.tokenize makes them, 0 where there is no word",
    "noise": "float32, standard normal",
}


def export_policy(
    run: RunDirectory, checkpoint: int | str, nfe: Sequence[int], folder: Path, count: int, calls: int
) -> Table:
    """Writes `infer<n>.onnx`, or its parts, and `infer<n>.json` for each of `nfe` into `folder`, which must not exist.

    Graphs are compared with the policy at `count` observations, and timed with `calls` predictions, before anything is
    written. Raises UserError where the policy cannot sample so, or a graph differs.
    """
    config, step = run.config(), run.weights_step(checkpoint)
    policy = load_policy(run, step)
    for steps in nfe:
        policy.check_sampling(steps, 1.0)
    observed = list(observations(config, policy, count))
    files: dict[str, bytes] = {}
    cards: dict[str, dict[str, Any]] = {}
    rows = []
    with Progress("exporting", len(nfe)) as bar:
        for steps in nfe:
            graphs = policy_graphs(policy, steps)
            exported = OnnxPolicy(policy, steps, graphs)
            difference = largest_difference(policy, exported, steps, observed)
            times = latencies(policy, exported, steps, observed[0], calls)
            name = f"infer{steps}"
            named = {f"{name}.onnx" if len(graphs) == 1 else f"{name}_{part}.onnx": part for part in graphs}
            files |= {file: graphs[part] for file, part in named.items()}
            cards[f"{name}.json"] = {
                "format": FORMAT,
                "experiment": config["name"],
                "nfe": steps,
                "checkpoint_step": step,
                "weights": run.weights_digest(step),
                "config_digest": digest_of_config(config),
                "graphs": {part: file for file, part in named.items()},
                "digests": {part: digest_of_graph(graph) for part, graph in graphs.items()},
                **_interface(policy),
                "parity": {
                    "observations": len(observed),
                    "largest_difference": difference,
                    "at_most": TOLERANCE,
                },
                "latency": {**times, "threads": 1, "calls": calls},
                "fingerprint": fingerprint(threads=1),
            }
            rows.append(
                (
                    str(steps),
                    *(number(times[key], 2) for key in ("eager_ms", "onnx_ms", "ratio")),
                    f"{difference:.1e}",
                )
            )
            bar.advance()
    write_folder(folder, files, cards)
    columns = ("nfe", "Eager [ms]", "ONNX Runtime [ms]", "Ratio", "Largest difference")
    note = (
        f"One thread, medians of {calls} predictions in turn. Differences over {len(observed)} observations."
    )
    return Table(f"{config['name']}, weights of step {step}, as ONNX", columns, tuple(rows), (note,))


def _interface(policy: Policy) -> dict[str, Any]:
    """What a caller must know of inputs and outputs."""
    example = blank_observation(policy)
    shapes = {
        "images": list(example.images.shape),
        "state": list(example.state.shape),
        "instruction": list(example.instruction.shape),
        "noise": [1, *policy.noise_shape],
    }
    return {
        "robot": policy.robot.to_json(),
        "views": list(policy.views),
        "horizon": asdict(policy.horizon),
        "inputs": {name: {"shape": shapes[name], "meaning": INPUTS[name]} for name in INPUTS},
        "output": {
            "shape": [1, *policy.noise_shape],
            "meaning": "float32, the action channels of `robot` in its units, one row for each predicted step",
        },
    }


def write_folder(folder: Path, files: dict[str, bytes], cards: dict[str, dict[str, Any]]) -> None:
    """Makes `folder` of graphs and cards, whole or not at all.

    Raises UserError where it exists, or cannot be written.
    """
    part = folder.with_name(f".{folder.name}.part")
    with clear_write_errors(folder):
        make_folder(folder.parent)
        with locked(folder):
            refuse_existing(folder, EXISTING)  # another process may have made it meanwhile
            shutil.rmtree(part, ignore_errors=True)
            try:
                part.mkdir()
                for name, content in files.items():
                    (part / name).write_bytes(content)
                for name, card in cards.items():
                    write_json(part / name, card)
                put_folder(part, folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)
