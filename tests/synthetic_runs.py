"""Run directories as an evaluation leaves them, without training: what a policy did is drawn from its quality."""

import json
from pathlib import Path

import numpy as np
import yaml

from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.metrics import summarise

MACHINE = {"cpu": "a fast CPU", "cpu_flags": ["avx2"], "physical_cores": 2}
CODE = {"version": "0.1.0", "commit": "0" * 40, "dirty": False}
STEPS = 600


def make_run(path: Path, name: str, *, seed: int = 0, steps: int = STEPS, **config) -> Path:
    """A run directory of experiment `name` with its config and a learning curve."""
    path.mkdir(parents=True, exist_ok=True)
    whole = {"name": name, "seed": seed, "training": {"steps": steps}, "horizon": {"exec": 16}, **config}
    (path / "config.yaml").write_text(yaml.safe_dump(whole))
    rows = [{"step": step, "loss": 2.0 * step**-0.3} for step in range(100, steps + 1, 100)]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def episodes_of(
    quality: float, first_seed: int, number: int, *, task: str, latency_ms: float, stream: int = 0
) -> list[dict]:
    """Rows of `number` episodes; starts are as hard as their seeds make them, alike for every policy."""
    top = 5 if task == "socket" else 4
    rows = []
    for seed in range(first_seed, first_seed + number):
        luck = np.random.default_rng(seed).normal() + 0.5 * np.random.default_rng([seed, stream]).normal()
        reached = int(np.clip(np.floor((quality + 0.25 * luck) * (top + 1)), 0, top))
        steps = [80 + 40 * stage if stage < reached else -1 for stage in range(top)]
        times = 1.0 + 0.1 * np.random.default_rng([seed, stream, 1]).random(4)
        rows.append(
            {
                "seed": seed, "start_digest": f"{seed:016x}", "num_steps": 700,
                "total_reward": float(sum(700 - step for step in steps if step > 0)), "max_reward": float(reached),
                "success": reached == top, "first_step_of_stage": steps, "failure": None,
                "timing": {"wall_s": 2.0, "inference_ms": [round(latency_ms * time, 3) for time in times]},
            }
        )  # fmt: skip
    return rows


def write_evaluation(
    run: Path,
    nfe: int,
    *,
    quality: float = 0.6,
    task: str = "socket",
    first_seed: int = 100_000,
    number: int = 20,
    step: int = STEPS,
    latency_ms: float = 6.0,
    stream: int = 0,
    machine: dict | None = None,
    **protocol,
) -> Path:
    """A finished evaluation in `run`; returns its folder. `protocol` changes what summary.json says of it."""
    rows = episodes_of(quality, first_seed, number, task=task, latency_ms=latency_ms, stream=stream)
    config = yaml.safe_load((run / "config.yaml").read_text())
    name, weights = config["name"], f"{config.get('seed', 0):016x}"
    seeds = [first_seed, first_seed + number - 1]
    summary = summarise(rows) | {
        "experiment": name, "nfe": nfe, "checkpoint_step": step, "seeds": seeds,
        "protocol": {
            "task": task, "variant": "default", "checkpoint_step": step, "weights": weights, "nfe": nfe,
            "noise_seed": 0, "first_seed": first_seed, "episodes": number, "max_steps": None, "device": "cpu",
        } | protocol,
        "fingerprint": {"code": CODE, "machine": machine or MACHINE, "threads": 1, "workers": 2},
    }  # fmt: skip
    suffix = "" if step == STEPS else f"_step{step}"
    suffix += "".join(f"_{key}{value}" for key, value in protocol.items())
    folder = run / "rollouts" / f"seeds{seeds[0]}-{seeds[1]}_nfe{nfe}{suffix}"
    folder.mkdir(parents=True, exist_ok=True)
    summary["name"] = folder.name
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return folder


def answer_row(root: Path, row: TableRow, *, quality: float = 0.6, seed: int = 0, **options) -> Path:
    """A run below `root` with the evaluation that a row wants; returns the evaluation's folder."""
    names = [name for name in (row.run, f"seed={seed}" if seed else "") if name]
    run = make_run(root / row.experiment / (",".join(names) or "default"), row.experiment, seed=seed)
    task = read_mapping().table(row.table).task
    defaults = {
        "task": task, "number": row.wanted.episodes, "step": row.step(STEPS), "latency_ms": 3.0 + 3.0 * row.nfe,
        "stream": row.nfe,
    }  # fmt: skip
    return write_evaluation(run, row.nfe, quality=quality, **(defaults | options))
