"""What one worker of an evaluation does: build environment and policy once, then roll out seed after seed."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from imfvla.environment import Environment
from imfvla.environments import environment_of
from imfvla.environments.rollout import run_episode
from imfvla.reporting.records import Row
from imfvla.reporting.rows import row_of, untimed
from imfvla.rollouts.actor import ChunkActor
from imfvla.storage.run_directory import RunDirectory

VIDEO_HEIGHT = 240  # of a view [px]

Build = Callable[[Path, int], tuple[Environment, Any]]  # run directory, training step -> environment, policy


@dataclass(frozen=True, slots=True)
class Job:
    """What the episodes of an evaluation share. Pickled and sent to the workers."""

    build: Build
    run: Path
    step: int
    nfe: int
    noise_seed: int
    noise_scale: float
    max_steps: int | None
    device: str  # of the policy


def load_workbench(run: Path, step: int) -> tuple[Environment, Any]:
    """The environment that a run was configured for, and its policy as it was after `step` training steps."""
    from imfvla.training.checkpoint import load_policy

    directory = RunDirectory(run)
    with ExitStack() as made:
        env = made.enter_context(closing(environment_of(directory.config())))
        policy = load_policy(directory, step)
        made.pop_all()
        return env, policy


@dataclass(frozen=True, slots=True)
class World:
    """What a summary says of the world that was played in."""

    renderer: str
    stages: tuple[str, ...] | None  # their names; None where episodes have stages of different tasks


def describe_world(job: Job) -> World:
    """Of the environment in which episodes are played."""
    env, _ = _bench(job.build, job.run, job.step)
    return World(env.renderer(), None if env.goal else env.stages)


def roll_out(job: Job, seed: int) -> dict[str, Any]:
    """The row of the episode from `seed`."""
    return _play(job, seed, [])


def record(job: Job, expected: Row, path: Path) -> None:
    """Replays an evaluated episode into an MCAP file and a video of the same name.

    Raises RuntimeError where the outcome differs: then the simulator, the policy or the noise
    is not determined by the seed, and no number of the evaluation can be trusted.
    """
    from imfvla.recording import McapSink, VideoSink  # imported here: nothing else writes videos

    env, _ = _bench(job.build, job.run, job.step)
    sinks = [
        McapSink(path, lossless=False),
        VideoSink(path.with_suffix(".mp4"), views=tuple(env.views), height=VIDEO_HEIGHT),
    ]
    row = _play(job, expected["seed"], sinks)
    before, after = untimed(expected), untimed(row)
    if before != after:
        raise RuntimeError(f"Seed {expected['seed']} played twice differs: {before}, then {after}.")


def _play(job: Job, seed: int, sinks: Sequence[Any]) -> dict[str, Any]:
    env, policy = _bench(job.build, job.run, job.step)
    policy.check_sampling(job.nfe, job.noise_scale)
    actor = ChunkActor(
        policy.to(job.device),
        policy.horizon,
        job.nfe,
        job.noise_seed,
        job.device,
        noise_scale=job.noise_scale,
    )
    config = RunDirectory(job.run).config() if sinks else {}
    metadata = {"policy": str(config.get("name", "")), "nfe": job.nfe, "checkpoint_step": job.step}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = run_episode(
            env, actor, seed, sinks, kind="rollout", config=config, metadata=metadata, max_steps=job.max_steps
        )
    finally:
        torch.set_num_threads(threads)
    return row_of(result)


@lru_cache(maxsize=1)
def _bench(build: Build, run: Path, step: int) -> tuple[Environment, Any]:
    return build(run, step)
