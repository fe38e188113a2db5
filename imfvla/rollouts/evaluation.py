"""Evaluation: many episodes of one policy on all cores; rows, a summary and three recordings."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from imfvla.config.protocol import EvaluationOptions, Protocol
from imfvla.errors import UserError
from imfvla.options import require
from imfvla.process.progress import Progress
from imfvla.process.workers import Here, Pool, worker_pool
from imfvla.reporting.metrics import summarise
from imfvla.reporting.records import Row
from imfvla.rollouts.rollout_log import RolloutLog
from imfvla.rollouts.workbench import Build, Job, describe_world, load_workbench, record, roll_out
from imfvla.storage.documents import read_json
from imfvla.storage.fingerprint import fingerprint, physical_cores
from imfvla.storage.run_directory import RunDirectory, flatten
from imfvla.storage.trained_config import DIGEST, digest_of_config, refuse_changed_config, refuse_other_config

REQUIRED_KEYS = ("name", "task.name", "observation.views", "observation.image_size")
USUAL_VARIANT = "default"  # of a task that has no other


def evaluate(
    run: RunDirectory, options: EvaluationOptions, *, build: Build = load_workbench
) -> list[dict[str, Any]]:
    """Rolls the policy of `run` out from the seeds `first_seed, first_seed + 1, ...`, once for each of `nfe`.

    For each, writes `rollouts/<name>/` with `episodes.jsonl` (ordered by seed, equal for equal protocols
    but for the key "timing"), `summary.json`, and, with `recordings`, MCAP and mp4 of the best, the
    median and the worst episode. An interrupted evaluation resumes where it stopped; a finished one is
    not repeated, unless `overwrite`. `build` makes environment and policy, in each worker once.

    Returns:
      The summaries, in the order of `nfe`.

    Raises:
      UserError: no run, no such weights, no such device, an episode whose workers died, or a config.yaml that was
        changed since the weights were trained or other evaluations were made.
    """
    require_device(options.device, "device")
    config = run.config()
    missing = [key for key in REQUIRED_KEYS if key not in flatten(config)]
    if missing:
        raise UserError(
            f"{run.path}/config.yaml lacks {', '.join(missing)}: wanted the config of a training run."
        )
    run.refuse_strangers()
    step = run.weights_step(options.checkpoint)
    digest = run.weights_digest(step)
    refuse_changed_config(run, config, step)
    for path in sorted(run.path.glob("rollouts/*/summary.json")):
        refuse_other_config(config, run.path, path, _config_digest(path, run.path))
    config_digest = digest_of_config(config)
    count = min(physical_cores() if options.workers is None else options.workers, options.episodes)
    summaries = []
    with worker_pool(count, options.episode_timeout_s) as run_all:
        for number in options.nfe:
            protocol = Protocol(
                task=config["task"]["name"],
                variant=config["task"].get("variant", USUAL_VARIANT),
                checkpoint_step=step,
                weights=digest,
                nfe=number,
                noise_seed=options.noise_seed,
                noise_scale=options.noise_scale,
                first_seed=options.first_seed,
                episodes=options.episodes,
                max_steps=options.max_steps,
                device=options.device,
            )
            job = Job(
                build,
                run.path,
                step,
                number,
                options.noise_seed,
                options.noise_scale,
                options.max_steps,
                options.device,
            )
            name = protocol.name(run.weight_steps()[-1])
            with RolloutLog(
                run.rollouts(name), asdict(protocol), config_digest=config_digest, overwrite=options.overwrite
            ) as rollouts:
                if rollouts.summary is None:
                    incidents_before = run_all.incidents
                    (world,) = run_all(describe_world, [(job,)])
                    rollouts.begin(gl_renderer=world.renderer)
                    rows = _roll_out_all(job, protocol, rollouts, run_all)
                    files = _record_some(job, rows, rollouts, run_all) if options.recordings else {}
                    summary = {
                        **summarise(rows),
                        "name": name,
                        "experiment": config["name"],
                        "nfe": number,
                        "checkpoint_step": step,
                        **({} if world.stages is None else {"stages": list(world.stages)}),
                        "seeds": [protocol.seeds[0], protocol.seeds[-1]],
                        "protocol": asdict(protocol),
                        "recordings": files,
                        "worker_incidents": run_all.incidents - incidents_before,
                        "fingerprint": fingerprint(threads=1, workers=count, gl_renderer=world.renderer),
                    }
                    rollouts.finish(rows, summary)
                summaries.append(rollouts.summary)
    return summaries


def _config_digest(summary: Path, home: Path) -> Any:
    """Of the config that a finished evaluation was made with; None where its summary does not say it."""
    try:
        return read_json(summary, "evaluate again", mapping=True, home=home).get(DIGEST)
    except UserError:  # an evaluation that is not asked for
        return None


def require_device(device: str, key: str) -> None:
    """Raises UserError where the option `key` wants a GPU and there is none."""
    require(device == "cpu" or torch.cuda.is_available(), key, "cpu, as torch finds no CUDA device", device)


def _roll_out_all(job: Job, protocol: Protocol, rollouts: RolloutLog, run_all: Here | Pool) -> list[Row]:
    """The rows of all seeds, ordered; missing ones are played."""
    rows = {row["seed"]: row for row in rollouts.rows}
    missing = [seed for seed in protocol.seeds if seed not in rows]
    with Progress(f"{protocol.task}, nfe {protocol.nfe}", protocol.episodes, done=len(rows)) as bar:
        for row in run_all(roll_out, [(job, seed) for seed in missing]):
            rows[row["seed"]] = row
            rollouts.append(row)
            bar.advance(f"success {sum(r['success'] for r in rows.values())} of {len(rows)}")
    return [rows[seed] for seed in protocol.seeds]


def _record_some(job: Job, rows: Sequence[Row], rollouts: RolloutLog, run_all: Here | Pool) -> dict[str, Any]:
    """Replays the best, the median and the worst episode into files; returns which they are."""
    chosen = best_median_worst(rows)
    paths = {label: rollouts.path / f"{label}_seed{row['seed']}.mcap" for label, row in chosen.items()}
    calls = [(job, row, paths[label]) for label, row in chosen.items()]
    with Progress(f"recording {', '.join(chosen)} of nfe {job.nfe}", len(calls)) as bar:
        for _ in run_all(record, calls):
            bar.advance()
    return {
        label: {"seed": row["seed"], "return": row["total_reward"], "file": paths[label].name}
        for label, row in chosen.items()
    }


def best_median_worst(rows: Sequence[Row]) -> dict[str, Row]:
    """The rows of highest, middle and lowest return; of equal returns the lower seed counts as higher."""
    ranked = sorted(rows, key=lambda row: (-row["total_reward"], row["seed"]))
    chosen = {"best": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "worst": ranked[-1]}
    seen: set[int] = set()
    return {label: row for label, row in chosen.items() if not (row["seed"] in seen or seen.add(row["seed"]))}
