"""How far the chunks of exported graphs are from the policy's own, and how long both take."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import torch

from imfvla.config.protocol import SELECTION_FIRST_SEED
from imfvla.environments import environment_of
from imfvla.errors import UserError
from imfvla.policy import Policy
from imfvla.policy.noise import chunk_noise
from imfvla.process.progress import Progress
from imfvla.process.stopwatch import times_ms
from imfvla.robot_of import has_environment
from imfvla.rollouts.inference import observation_of
from imfvla.rollouts.threads import threads
from imfvla.runtime.onnx_policy import OnnxPolicy
from imfvla.sources.opening import open_source
from imfvla.training.data import held_out_windows, prepare_windows
from imfvla.types import Observation, tokenize

TOLERANCE = 1e-5  # of a chunk's entries, in the units of the actions


def observations(config: Mapping[str, Any], policy: Policy, count: int) -> Iterator[Observation]:
    """`count` start states of the band for choosing, or decisions of held-out episodes where there is no simulator."""
    if has_environment(config):
        with closing(environment_of(config)) as env:
            for seed in range(SELECTION_FIRST_SEED, SELECTION_FIRST_SEED + count):
                env.reset(seed)
                seen, steps = env.look(), policy.horizon.obs
                yield observation_of(
                    [[seen[view] for view in policy.views]] * steps,
                    [env.state()] * steps,
                    tokenize(env.instruction),
                    policy.image_size,
                )
    else:
        unseen = held_out_windows(prepare_windows(config, open_source(config)))
        rng = np.random.default_rng(0)
        for index in np.unique(np.linspace(0, len(unseen) - 1, count).astype(int)):
            yield unseen.batch(np.array([index]), rng).obs


@torch.inference_mode()
def largest_difference(
    policy: Policy, exported: OnnxPolicy, nfe: int, observed: Sequence[Observation]
) -> float:
    """Of all entries of a chunk at each observation, from the same noise. Raises UserError above `TOLERANCE`."""
    found = 0.0
    with Progress(f"comparing, nfe {nfe}", len(observed)) as bar:
        for number, obs in enumerate(observed):
            noise = chunk_noise(policy.noise_shape, [(0, number)])
            chunks = (one.predict(obs, noise, nfe) for one in (policy, exported))
            found = max(found, float(torch.sub(*chunks).abs().max()))
            bar.advance()
    if not found <= TOLERANCE:
        raise UserError(
            f"The graphs of nfe={nfe} differ from the policy by {found:.2g}: wanted at most {TOLERANCE:g}. Nothing was "
            "written; please report it with the run's config.yaml."
        )
    return found


@torch.inference_mode()
def latencies(
    policy: Policy, exported: OnnxPolicy, nfe: int, obs: Observation, calls: int
) -> dict[str, float]:
    """Medians of a prediction [ms] on one thread, eager and exported, in turn."""
    noise = chunk_noise(policy.noise_shape, [(0, 0)])
    with threads(1):
        eager, onnx = np.median(
            times_ms(
                [lambda: policy.predict(obs, noise, nfe), lambda: exported.predict(obs, noise, nfe)], calls
            ),
            axis=1,
        )
    return {"eager_ms": float(eager), "onnx_ms": float(onnx), "ratio": float(onnx / eager)}
