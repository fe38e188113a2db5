"""Evaluation: many episodes of one policy on all cores; rows, a summary and three recordings."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import torch

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import ONNX, EvaluationOptions, Protocol
from imfvla.errors import UserError
from imfvla.options import build as build_options
from imfvla.options import part_of, require
from imfvla.process.progress import Progress
from imfvla.process.workers import Here, Pool, worker_pool
from imfvla.reporting.metrics import summarise
from imfvla.reporting.records import Latency, Row
from imfvla.robot_of import robot_of
from imfvla.rollouts.clock import delay_steps
from imfvla.rollouts.latency import latency_of
from imfvla.rollouts.rollout_log import RolloutLog
from imfvla.rollouts.workbench import (
    Build,
    Job,
    describe_world,
    load_workbench,
    measure_alone,
    record,
    roll_out,
)
from imfvla.runtime.graphs import read_graphs, require_packages
from imfvla.storage.documents import read_json
from imfvla.storage.fingerprint import fingerprint, physical_cores
from imfvla.storage.run_directory import RunDirectory, flatten
from imfvla.storage.trained_config import DIGEST, digest_of_config, refuse_changed_config, refuse_other_config

REQUIRED_KEYS = ("name", "task.name", "observation.views", "observation.image_size")
USUAL_VARIANT = "default"  # of a task that has no other
log = logging.getLogger(__name__)


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
      UserError: no run, no such weights, no such device, no graphs of them for ONNX Runtime, an episode whose
        workers died, or a config.yaml that was changed since the weights were trained or other evaluations were made.
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
    if options.runtime == ONNX:
        require_packages()
        for number in options.nfe:
            read_graphs(run, step, number)
    digest = run.weights_digest(step)
    refuse_changed_config(run, config, step)
    for path in sorted(run.path.glob("rollouts/*/summary.json")):
        refuse_other_config(config, run.path, path, _config_digest(path, run.path))
    config_digest = digest_of_config(config)
    batches = math.ceil(options.episodes / options.batch)
    count = min(physical_cores() if options.workers is None else options.workers, batches)
    patience_s = None if options.episode_timeout_s is None else options.batch * options.episode_timeout_s
    protocols = [
        Protocol(
            task=config["task"]["name"],
            variant=config["task"].get("variant", USUAL_VARIANT),
            checkpoint_step=step,
            weights=digest,
            nfe=number,
            **options.in_protocol(),
        )
        for number in options.nfe
    ]
    timed = [_timed(run, config, protocol, options, build) for protocol in protocols]
    summaries = []
    with worker_pool(count, patience_s) as run_all:
        for protocol, latency in timed:
            job = Job(build, run.path, protocol)
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
                        "nfe": protocol.nfe,
                        "checkpoint_step": step,
                        **({} if world.stages is None else {"stages": list(world.stages)}),
                        "seeds": [protocol.seeds[0], protocol.seeds[-1]],
                        "protocol": asdict(protocol),
                        **({} if latency is None else {"latency_alone": latency}),
                        "recordings": files,
                        "worker_incidents": run_all.incidents - incidents_before,
                        "fingerprint": fingerprint(threads=1, workers=count, gl_renderer=world.renderer),
                    }
                    rollouts.finish(rows, summary)
                summaries.append(rollouts.summary)
    return summaries


def refuse_long_delay(config: Mapping[str, Any], options: EvaluationOptions) -> None:
    """Raises UserError where the policy of a config cannot bear the delay; a measured one is not known yet."""
    if options.is_running and not options.is_measured:
        _delay_steps(config, options.delay_ms, options)


def _delay_steps(config: Mapping[str, Any], delay_ms: float, options: EvaluationOptions) -> int:
    horizon = build_options(Horizon, part_of(config, "horizon"), "horizon")
    return delay_steps(delay_ms, robot_of(config).control_hz, horizon, options.meanwhile, options.prefix)


def _timed(
    run: RunDirectory,
    config: Mapping[str, Any],
    protocol: Protocol,
    options: EvaluationOptions,
    build: Build,
) -> tuple[Protocol, Latency | None]:
    """The protocol with its delay in control steps, and the latency that was measured for it, alone."""
    if not options.is_running:
        return protocol, None
    if not options.is_measured:
        return replace(protocol, delay_steps=_delay_steps(config, options.delay_ms, options)), None

    def measure() -> Latency:
        count = 0 if options.workers == 0 else 1
        with worker_pool(count, options.episode_timeout_s) as run_alone:
            (latency,) = run_alone(measure_alone, [(Job(build, run.path, protocol),)])
        return latency

    latency = latency_of(run, protocol, measure, again=options.overwrite)
    log.info("a chunk takes %.1f ms alone, at a load of %.1f", latency["median_ms"], latency["load"])
    steps = _delay_steps(config, latency["median_ms"], options)
    return replace(protocol, delay_steps=steps), latency


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
        for played in run_all(roll_out, [(job, seeds) for seeds in _batches(protocol, missing)]):
            for row in played:
                rows[row["seed"]] = row
                rollouts.append(row)
                bar.advance(f"success {sum(r['success'] for r in rows.values())} of {len(rows)}")
    return [rows[seed] for seed in protocol.seeds]


def _batches(protocol: Protocol, seeds: Sequence[int]) -> list[list[int]]:
    """Ascending seeds by the batch that they are played in; a resumed evaluation leaves places of one empty."""
    return [
        list(own) for _, own in groupby(seeds, lambda seed: (seed - protocol.first_seed) // protocol.batch)
    ]


def _record_some(job: Job, rows: Sequence[Row], rollouts: RolloutLog, run_all: Here | Pool) -> dict[str, Any]:
    """Replays the best, the median and the worst episode into files; returns which they are."""
    chosen = best_median_worst(rows)
    paths = {label: rollouts.path / f"{label}_seed{row['seed']}.mcap" for label, row in chosen.items()}
    calls = [(job, row, paths[label]) for label, row in chosen.items()]
    with Progress(f"recording {', '.join(chosen)} of nfe {job.protocol.nfe}", len(calls)) as bar:
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
