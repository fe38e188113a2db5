"""How far the Jacobian-vector product of Mean Flow is off where products round their inputs, as TF32 does.

Shapes: B batch, Tp predicted steps, A action.
"""

import copy
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from imfvla.policy import Policy
from imfvla.training.precision import FP32, TF32, allow_tf32
from imfvla.types import Observation

DROPPED_BITS = 13  # of the 23 of float32's fraction
aten = torch.ops.aten
PRODUCTS = {  # operators whose inputs a tensor core rounds, and which of their arguments these are
    aten.mm.default: (0, 1),
    aten.addmm.default: (1, 2),
    aten.bmm.default: (0, 1),
    aten.baddbmm.default: (1, 2),
    aten.convolution.default: (0, 1),
}


def round_to_tf32(x: Tensor) -> Tensor:
    """float32 rounded to 10 bits of fraction, to the nearest and of two to the even one; finite numbers only."""
    bits = x.contiguous().view(torch.int32)
    even = (bits >> DROPPED_BITS) & 1
    kept = (bits + (2 ** (DROPPED_BITS - 1) - 1) + even) & -(2**DROPPED_BITS)
    return kept.view(torch.float32)


class RoundedProducts(TorchDispatchMode):
    """Inside, products and convolutions of float32 round their inputs to TF32 and add up in float32."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        if func in PRODUCTS and args[PRODUCTS[func][0]].dtype == torch.float32:
            args = tuple(
                round_to_tf32(arg) if place in PRODUCTS[func] else arg for place, arg in enumerate(args)
            )
        return func(*args, **(kwargs or {}))


@torch.no_grad()
def derivative_errors(
    policy: Policy, observation: Observation, *, seed: int = 0
) -> dict[str, dict[str, float]]:
    """Relative errors of u, du/dt and u + (t - r) du/dt (paper eq. 6 and 7) in fp32 and TF32, against float64.

    `policy` learns an average velocity with its derivative; its device computes, without a GPU TF32 is imitated. Noisy
    chunks, velocities and times are drawn from `seed`, the same for all.
    """
    device = next(policy.parameters()).device
    rng = torch.Generator().manual_seed(seed)
    shape = (len(observation.state), *policy.noise_shape)
    z, v = (torch.randn(shape, generator=rng).to(device) for _ in range(2))
    t = (0.1 + 0.9 * torch.rand(shape[0], generator=rng)).to(device)
    r = t * torch.rand(shape[0], generator=rng).to(device)
    context = policy.context(observation.to(device))
    allow_tf32(FP32)
    exact = _derivative(
        policy, copy.deepcopy(policy.core).double(), context, *(x.double() for x in (z, r, t, v))
    )
    found = {}
    for precision in (FP32, TF32):
        imitated = precision == TF32 and device.type != "cuda"
        around: AbstractContextManager[Any] = RoundedProducts() if imitated else nullcontext()
        allow_tf32(precision)
        try:
            with around:
                answers = _derivative(policy, policy.core, context, z, r, t, v)
        finally:
            allow_tf32(FP32)
        names = ("u", "derivative", "compound")
        found[precision] = {
            name: float((answer.double() - true).norm() / true.norm())
            for name, answer, true in zip(names, answers, exact, strict=True)
        }
    return found


def _derivative(
    policy: Policy, core: nn.Module, context: Any, z: Tensor, r: Tensor, t: Tensor, v: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    u, push = policy.generator.linearise(core, z, r, t, context.detach(z.dtype), slice(None))
    slope = push(v)
    return u, slope, u + (t - r)[:, None, None] * slope
