"""One episode: an actor in an environment, watched by sinks; demonstrations and policy rollouts alike."""

import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from imfvla.environment import Environment, Outcome
from imfvla.episode import ActionError, Actor, EpisodeInfo, EpisodeResult, Sink, Step
from imfvla.errors import UserError

NON_FINITE = "non-finite action"
FAR_OUT_OF_RANGE = "action far out of range"
SIMULATION_ENDED = "simulation ended early"


Running = Generator[
    tuple[np.ndarray, int], None, EpisodeResult
]  # state (S,) and number of each step, then the row


def run_episode(
    env: Environment, actor: Actor, seed: int, sinks: Sequence[Sink], **said: Any
) -> EpisodeResult:
    """Runs an `episode` from start to end and returns its row."""
    running = episode(env, actor, seed, sinks, **said)
    while True:
        try:
            next(running)
        except StopIteration as end:
            return end.value


def episode(
    env: Environment,
    actor: Actor,
    seed: int,
    sinks: Sequence[Sink],
    *,
    kind: str,
    config: Mapping[str, Any],
    metadata: Mapping[str, Any] | None = None,
    max_steps: int | None = None,
) -> Running:
    """Runs the episode that starts from `seed`, step by step, and returns its row.

    It yields state and number of a step before the actor acts there, so that several episodes can run side by side.
    The episode lasts until the environment ends it, until `max_steps` control steps, or until
    `actor.done(env)` where the actor has a `done` (demonstrators stop some steps after success; policies
    run to the end). It is a success where the last step's outcome says so. An environment that ends an episode before
    its time limit, and without success, has failed it.

    An actor that raises `ActionError` or executes a non-finite action ends the episode as failed: the row
    keeps the reward collected so far, carries the label and counts as no success. Any other exception
    aborts the sinks and is re-raised. UserError where the environment does not do what its robot says.

    Args:
      env: any world; its `robot` says how much time a control step takes.
      actor: an `episode.Actor`; its `style`, where it has one, goes into the recording's metadata.
      seed: draws the start state, and whatever the actor draws.
      sinks: recorders; they begin in order after the reset and end in order after the last step.
      kind: "demonstration" or "rollout".
      config: attached to the recording in full.
      metadata: policy name, nfe and the like.
      max_steps: an upper bound on the control steps, for short tests.

    Returns:
      The episode's row; `first_step_of_stage[k - 1]` is the first step after which stage k or higher held, and it is
      empty where the task has no stages.
    """
    env.reset(seed)
    _refuse_misfit(env)
    start_digest = env.start_digest()
    actor.reset(env, seed)
    done = getattr(actor, "done", None)
    limit = env.time_limit_steps if max_steps is None else min(max_steps, env.time_limit_steps)
    info = EpisodeInfo(
        task=env.name,
        kind=kind,
        seed=seed,
        start_digest=start_digest,
        instruction=env.instruction,
        views=tuple(env.views),
        robot=env.robot,
        config=config,
        metadata={
            **(metadata or {}),
            **({"paraphrases": env.paraphrases} if env.paraphrases else {}),
            **({"style": dict(actor.style)} if hasattr(actor, "style") else {}),
        },
    )
    rewards: list[float] = []
    inference_ms: list[float] = []
    jumps: list[float] = []
    first_step_of_stage = [-1] * len(env.stages)
    outcome = Outcome(reward=0.0, stage=0, success=False, ended=False)
    failure = None
    with ExitStack() as aborts:
        for sink in sinks:
            aborts.callback(sink.abort)
            sink.begin(env, info)
        began = time.perf_counter()
        for index in range(limit):
            state = env.state()
            yield state, index
            try:
                decision = actor.act(env, state, index)
                if not np.isfinite(decision.executed).all():
                    raise ActionError(NON_FINITE)
            except ActionError as error:
                failure = str(error)
                break
            outcome = env.step(decision.executed)
            rewards.append(float(outcome.reward))
            if decision.inference_ms is not None:
                inference_ms.append(float(decision.inference_ms))
            if decision.jump is not None:
                jumps.append(decision.jump)
            for reached in range(outcome.stage):
                if first_step_of_stage[reached] < 0:
                    first_step_of_stage[reached] = index
            step = Step(index, index / env.robot.control_hz, state, decision, rewards[-1], outcome.stage)
            for sink in sinks:
                sink.step(env, step)
            if outcome.ended:
                if index + 1 < env.time_limit_steps and not outcome.success:
                    failure = SIMULATION_ENDED
                break
            if done is not None and done(env):
                break
        result = EpisodeResult(
            seed=seed,
            start_digest=start_digest,
            num_steps=len(rewards),
            total_reward=float(sum(rewards)),
            max_reward=max(rewards, default=0.0),
            success=failure is None and outcome.success,
            first_step_of_stage=tuple(first_step_of_stage),
            failure=failure,
            inference_ms=tuple(inference_ms),
            wall_s=time.perf_counter() - began,
            goal=env.goal,
            chunk_jump=float(np.mean(jumps)) if jumps else None,
            condition_happened=getattr(env, "condition_happened", None),
        )
        for sink in sinks:
            sink.end(result)
        aborts.pop_all()
    return result


def _refuse_misfit(env: Environment) -> None:
    """Raises UserError where what an environment shows is not what its robot says."""
    for view in env.views:
        env.robot.camera(view)
    state, wanted = np.asarray(env.state()), len(env.robot.state)
    if state.shape != (wanted,):
        raise UserError(
            f"The environment {env.name} does not fit its robot: state() must be {wanted} numbers, as the robot has "
            f"state channels, found an array of shape {state.shape}; correct one of them."
        )
