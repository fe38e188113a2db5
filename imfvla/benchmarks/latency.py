"""The time of one action chunk at batch 1 on one thread, from numpy observation to numpy chunk, and its parts."""

from collections.abc import Sequence

import numpy as np
import torch

from imfvla.benchmarks.sizes import core_inputs
from imfvla.environment import Environment
from imfvla.policy import Policy
from imfvla.process.stopwatch import times_ms
from imfvla.reporting.statistics.bootstrap import bootstrap
from imfvla.reporting.statistics.resampling import OfOrdered, middle
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.inference import observation_of
from imfvla.rollouts.threads import threads
from imfvla.types import tokenize

FEWEST_CALLS = 50  # of a sampler with many steps
LOG_MEDIAN = OfOrdered(lambda *counted: np.log(middle(*counted)))


def measure_latency(
    env: Environment, policy: Policy, nfe: Sequence[int], *, calls: int, warm_up: int, num_threads: int = 1
) -> dict[str, dict[str, float]]:
    """Times [ms] by "infer1", ...: median and p95 of a chunk, and the medians of its parts.

    `log_error` is the bootstrapped standard error of the median's logarithm, over calls as if they were independent.

    The parts are the encoder with its conditioning, one call of the core, and the overhead: what a chunk takes beyond
    the encoder and n calls; `of_parts` is the chunk over the sum of encoder and n calls. Chunk and parts are timed in
    turn, so that all see the same machine: `calls` / n times, at least min(50, `calls`).
    """
    env.reset(seed=0)
    obs = policy.horizon.obs
    seen = env.look()
    pictures = [seen[view] for view in policy.views]
    images, states = [pictures] * obs, [env.state()] * obs
    observation = observation_of(images, states, tokenize(env.instruction), policy.image_size)
    noise = torch.randn(1, *policy.noise_shape)
    measured = {}
    with threads(num_threads), torch.inference_mode():
        inputs = core_inputs(policy.eval(), observation, noise, min(nfe))
        for number in nfe:
            actor = ChunkActor(policy, policy.horizon, number, noise_seed=0)
            actor.reset(env, 0)
            chunk, encoder, core = times_ms(
                [
                    lambda actor=actor: actor.plan(images, states, 0),
                    lambda: policy.core.condition(policy.encoder(observation)),
                    lambda: policy.core(*inputs),
                ],
                min(calls, max(FEWEST_CALLS, calls // number)),
                max(1, warm_up // number),
            )
            parts = encoder + number * core
            measured[f"infer{number}"] = {
                "median_ms": float(np.median(chunk)),
                "p95_ms": float(np.percentile(chunk, 95)),
                "log_error": bootstrap(LOG_MEDIAN, chunk).error or 0.0,
                "encoder_ms": float(np.median(encoder)),
                "core_evaluation_ms": float(np.median(core)),
                "overhead_ms": float(np.median(chunk - parts)),
                "of_parts": float(np.median(chunk / parts)),
            }
    return measured
