"""What one worker of an evaluation does: build environments and policy once, then roll out seed after seed."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from imfvla.conditions import changed
from imfvla.config.condition import NONE
from imfvla.config.protocol import ONNX, Protocol, unusual
from imfvla.environment import Environment
from imfvla.environments import environment_of
from imfvla.environments.rollout import episode
from imfvla.reporting.records import Latency, Row
from imfvla.reporting.rows import row_of, untimed
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.clock import Clock
from imfvla.rollouts.latency import measure_latency
from imfvla.rollouts.lockstep import Player, play_in_lockstep
from imfvla.rollouts.threads import threads
from imfvla.runtime.graphs import read_graphs
from imfvla.runtime.onnx_policy import OnnxPolicy
from imfvla.storage.run_directory import RunDirectory

VIDEO_HEIGHT = 192  # of a view [px]: twice what the policies of the tables see

Build = Callable[[Path, int], tuple[Environment, Any]]  # run directory, training step -> environment, policy


@dataclass(frozen=True, slots=True)
class Job:
    """What the episodes of an evaluation share. Pickled and sent to the workers."""

    build: Build
    run: Path
    protocol: Protocol

    @property
    def step(self) -> int:
        """Of the weights."""
        return self.protocol.checkpoint_step


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
    """Of the environment in which episodes are played. Raises UserError where the policy cannot play as is wanted."""
    env, policy = _place(job)
    actor_of(job.protocol, policy)
    return World(env.renderer(), None if env.goal else env.stages)


def measure_alone(job: Job) -> Latency:
    """The time of a chunk of the job's policy, see `rollouts.latency`."""
    env, policy = _place(job)
    with threads(1):
        actor = actor_of(job.protocol, policy)
        return measure_latency(env, actor, policy.horizon.obs, policy.views, job.protocol.nfe)


def roll_out(job: Job, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """The rows of the episodes from `seeds`, played side by side in the places that the protocol gives them."""
    return _play(job, seeds, [])


def record(job: Job, expected: Row, path: Path) -> None:
    """Replays an evaluated episode into an MCAP file and a video of the same name.

    Raises RuntimeError where the outcome differs: then the simulator, the policy or the noise
    is not determined by the seed, and no number of the evaluation can be trusted.
    """
    from imfvla.recording import McapSink, VideoSink  # imported here: nothing else writes videos

    env, _ = _place(job)
    sinks = [
        McapSink(path, lossless=False),
        VideoSink(path.with_suffix(".mp4"), views=tuple(env.views), height=VIDEO_HEIGHT),
    ]
    (row,) = _play(job, [expected["seed"]], sinks)
    before, after = untimed(expected), untimed(row)
    if before != after:
        raise RuntimeError(f"Seed {expected['seed']} played twice differs: {before}, then {after}.")


def _play(job: Job, seeds: Sequence[int], sinks: Sequence[Any]) -> list[dict[str, Any]]:
    """Rows of episodes side by side. Only one that is alone may have sinks."""
    protocol = job.protocol
    _, policy = _place(job)
    config = RunDirectory(job.run).config() if sinks else {}
    metadata = {
        "policy": str(config.get("name", "")),
        "nfe": protocol.nfe,
        "checkpoint_step": job.step,
        **({"unusual": said} if (said := ", ".join(unusual(asdict(protocol)))) else {}),
    }
    said = {"kind": "rollout", "config": config, "metadata": metadata, "max_steps": protocol.max_steps}
    players = []
    for env, seed in zip(_worlds(job, len(seeds)), seeds, strict=True):
        actor = actor_of(protocol, policy)
        players.append(Player(protocol.place(seed), env, actor, episode(env, actor, seed, sinks, **said)))
    with threads(1):
        return [row_of(result) for result in play_in_lockstep(players, protocol.batch)]


def actor_of(protocol: Protocol, policy: Any) -> ChunkActor:
    """A policy at work as a protocol says. Raises UserError where it cannot work so."""
    policy.check_sampling(protocol.nfe, protocol.noise_scale, protocol.noise)
    policy.check_replanning(protocol.nfe, protocol.candidates, protocol.prefix)
    return ChunkActor(
        policy.to(protocol.device),
        policy.horizon,
        protocol.nfe,
        protocol.noise_seed,
        protocol.device,
        noise_scale=protocol.noise_scale,
        noise=protocol.noise,
        candidates=protocol.candidates,
        clock=Clock(policy.horizon, protocol.delay_steps, protocol.meanwhile),
        prefix=protocol.prefix,
        tells_jumps=protocol.tells_jumps,
    )


def _place(job: Job) -> tuple[Environment, Any]:
    """Environment and policy of a job, each made once."""
    protocol = job.protocol
    (env, *_), policy = _bench(job.build, job.run, job.step, protocol.condition, protocol.severity)
    return env, _exported(policy, job.run, job.step, protocol.nfe) if protocol.runtime == ONNX else policy


def _worlds(job: Job, count: int) -> list[Environment]:
    """So many environments of a job, each made once."""
    protocol = job.protocol
    envs, _ = _bench(job.build, job.run, job.step, protocol.condition, protocol.severity)
    while len(envs) < count:
        env, _ = job.build(job.run, job.step)  # whose policy is not needed again
        envs.append(changed(env, protocol.condition, protocol.severity))
    return envs[:count]


@lru_cache(maxsize=1)
def _exported(policy: Any, run: Path, step: int, nfe: int) -> OnnxPolicy:
    return OnnxPolicy(policy, nfe, read_graphs(RunDirectory(run), step, nfe))


@lru_cache(maxsize=1)
def _bench(
    build: Build, run: Path, step: int, condition: str = NONE, severity: int | None = None
) -> tuple[list[Environment], Any]:
    """A first environment, to which `_worlds` adds, for each condition, since some change its simulation."""
    env, policy = build(run, step)
    return [changed(env, condition, severity)], policy
