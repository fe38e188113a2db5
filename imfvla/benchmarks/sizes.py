"""Parameters of a policy, and floating-point operations of a chunk and of a training sample."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from imfvla.benchmarks.flops import count_flops, training_flops
from imfvla.command.rehearsal import build_unfitted
from imfvla.policy import Policy
from imfvla.policy.blank import blank_observation
from imfvla.types import Batch, Observation


def measure_size(config: Mapping[str, Any], nfe: Sequence[int]) -> dict[str, Any]:
    """Counts at batch 1, of a composed config: nothing is timed, weights are random.

    A chunk costs the encoder with its conditioning once and `n` calls of the core, for each n of `nfe`.
    """
    policy = build_unfitted(config)
    observation, noise = blank_observation(policy), torch.zeros(1, *policy.noise_shape)
    encoder = count_flops(lambda: policy.core.condition(policy.encoder(observation)))
    inputs = core_inputs(policy.eval(), observation, noise, min(nfe))
    core = count_flops(lambda: policy.core(*inputs))
    valid = torch.ones(1, policy.horizon.pred, dtype=torch.bool)
    parameters = [(p.numel(), p.requires_grad) for p in policy.parameters()]
    return {
        "parameters": sum(count for count, _ in parameters),
        "trained_parameters": sum(count for count, trained in parameters if trained),
        "encoder_gflop": encoder / 1e9,
        "core_evaluation_gflop": core / 1e9,
        "chunk_gflop": {f"infer{n}": (encoder + n * core) / 1e9 for n in nfe},
        "training_gflop_per_sample": training_flops(policy, Batch(observation, noise, valid), "fp32") / 1e9,
    }


def core_inputs(policy: Policy, observation: Observation, noise: Tensor, nfe: int) -> tuple[Any, ...]:
    """What the generator passes to the core in its first call of `nfe`, whatever its interface."""
    seen: list[tuple[Any, ...]] = []
    hook = policy.core.register_forward_pre_hook(lambda _, inputs: seen.append(inputs))
    try:
        policy.predict(observation, noise, nfe)
    finally:
        hook.remove()
    return seen[0]
