"""What an episode consists of, for simulator, recorder, evaluator and report. Needs numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from imfvla.environment import Environment
from imfvla.robot import RobotSpec


@dataclass(frozen=True, slots=True)
class EpisodeInfo:
    """What is known when an episode begins."""

    task: str
    kind: str  # "demonstration" | "rollout"
    seed: int  # passed to reset; draws the start state
    start_digest: str  # hex digest of the start state
    instruction: str
    views: tuple[str, ...]  # cameras that the actor sees
    robot: RobotSpec
    config: Mapping[str, Any]  # attached to the recording in full
    metadata: Mapping[str, Any] = field(default_factory=dict)  # expert style, policy name, nfe, ...


@dataclass(frozen=True, slots=True)
class Decision:
    """An actor's answer at one control step."""

    action: np.ndarray  # float32 (A,)  what a policy should learn here, physical units
    executed: np.ndarray  # float32 (A,)  what is applied: `action`, plus exploration noise in demonstrations
    images: Mapping[str, np.ndarray] | None = None  # view -> uint8 (H, W, 3), where the actor looked
    chunk: np.ndarray | None = None  # float32 (Tp, A), where it replanned
    inference_ms: float | None = None  # from numpy observation to numpy chunk, where it replanned
    jump: float | None = (
        None  # distance from the last chunk over the steps left of both, as a share of the actions' ranges
    )
    imitate: bool | None = (
        None  # whether a policy should learn what is done here; None: nothing is said, so it should
    )


@dataclass(frozen=True, slots=True)
class Step:
    """One control step: state and images hold before the action is applied, reward and stage after it."""

    index: int
    time_s: float  # simulated, before the action
    state: np.ndarray  # float32 (S,)
    decision: Decision
    reward: float
    stage: int


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One row of `episodes.jsonl`. Times are the only fields that differ between equal runs."""

    seed: int
    start_digest: str
    num_steps: int
    total_reward: float
    max_reward: float
    success: bool
    first_step_of_stage: tuple[int, ...]  # entry k - 1: first step at which stage k held, -1 for never
    failure: str | None  # label of an abnormal end ("non-finite action", ...), None for a normal one
    inference_ms: tuple[float, ...]  # one per replanning
    wall_s: float
    goal: str | None = None  # the task of the episode, where its scene serves several
    chunk_jump: float | None = None  # mean of the jumps, where its actor told them
    condition_happened: bool | None = None  # of a condition that is an event, whether it came


class ActionError(Exception):
    """Raised by an actor without a usable action; the episode then ends, failed with this label."""


class Actor(Protocol):
    """Chooses actions. A demonstrator may read the simulator behind `env`; a policy only looks through its cameras."""

    def reset(self, env: Environment, seed: int) -> None: ...
    def act(self, env: Environment, state: np.ndarray, step: int) -> Decision: ...


class Sink(Protocol):
    """Receives an episode as it happens: `begin`, each `step`, then `end` or, after an exception, `abort`."""

    def begin(self, env: Environment, info: EpisodeInfo) -> None: ...
    def step(self, env: Environment, step: Step) -> None: ...
    def end(self, result: EpisodeResult) -> None: ...
    def abort(self) -> None: ...
