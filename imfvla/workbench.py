"""What one worker of an evaluation does: build environment and policy once, then roll out seed after seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from imfvla.actor import ChunkActor
from imfvla.reporting.metrics import Row, row_of, untimed
from imfvla.rollout import run_episode
from imfvla.run_directory import RunDirectory

VIDEO_SIZE = (240, 240)  # (H, W) of a view [px]
VIDEO_EVERY = 2  # control steps between two frames of a video: 25 frames a second

Build = Callable[[Path, int], tuple[Any, Any]]  # run directory, training step -> environment, policy


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


def load_workbench(run: Path, step: int) -> tuple[Any, Any]:
    """The environment that a run was configured for, and its policy as it was after `step` training steps."""
    from imfvla import tasks  # here, since a GL backend is picked at import
    from imfvla.training.checkpoint import load_policy

    directory = RunDirectory(run)
    config = directory.config()
    env = tasks.load(
        config["task"]["name"],
        variant=config["task"]["variant"],
        views=tuple(config["observation"]["views"]),
        image_size=tuple(config["observation"]["image_size"]),
    )
    return env, load_policy(directory, step)


def gl_renderer(job: Job) -> str:
    """The name of the renderer, such as "llvmpipe (LLVM 15.0.6, 256 bits)"."""

    def ask() -> str:
        from OpenGL import GL  # here, since the platform is chosen when the environment is built

        return GL.glGetString(GL.GL_RENDERER).decode()

    env, _ = _bench(job.build, job.run, job.step)
    with env.physics.contexts.gl.make_current() as context:
        return context.call(ask)


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
        VideoSink(path.with_suffix(".mp4"), views=tuple(env.views), size=VIDEO_SIZE, every=VIDEO_EVERY),
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
def _bench(build: Build, run: Path, step: int) -> tuple[Any, Any]:
    return build(run, step)
