"""Floating-point operations of matrix products and convolutions, forward and backward.

Fused kernels hide theirs from the count: attention is computed in its plain form here.
"""

from collections.abc import Callable

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from imfvla.policy import Policy
from imfvla.training.precision import autocast
from imfvla.types import Batch

LAST_STEP = 999


def count_flops(function: Callable[[], object]) -> int:
    """Of one call of `function`."""
    fused = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
            function()
    finally:
        torch.backends.mha.set_fastpath_enabled(fused)
    return counter.get_total_flops()


def training_flops(policy: Policy, batch: Batch, precision: str) -> int:
    """Of one loss and its gradient at a training's end; the gradient is thrown away, the policy left in train mode."""
    policy.train()
    policy.begin_step(LAST_STEP, LAST_STEP + 1)  # of the stages of a training the last, which costs most

    def learn() -> None:
        with autocast(precision, batch.actions.device):
            loss, _ = policy.loss(batch, torch.Generator().manual_seed(0))
        loss.backward()

    flops = count_flops(learn)
    policy.zero_grad(set_to_none=True)
    return flops
