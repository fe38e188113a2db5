"""Forward-mode differentiation that spends nothing on constants.

PyTorch's own rule for a product multiplies a missing tangent as an array of zeros, so that a matrix product with
weights costs three products in place of two, and one with a cached context a slow strided one besides. Here the
tangent of x @ constant is tangent(x) @ constant.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


class _ConstantProduct(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, constant: Tensor) -> Tensor:
        return x @ constant

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.constant = inputs[1]

    @staticmethod
    def jvp(ctx: Any, x_tangent: Tensor, constant_tangent: None) -> Tensor:
        return x_tangent @ ctx.constant


def product(x: Tensor, constant: Tensor) -> Tensor:
    """x @ constant, where constant has no tangent of its own; in reverse mode an ordinary product."""
    if forward_ad.unpack_dual(x).tangent is None:
        return x @ constant
    return _ConstantProduct.apply(x, constant)


def jvp(
    function: Callable[..., Tensor], primals: tuple[Tensor, ...], tangents: tuple[Tensor | None, ...]
) -> tuple[Tensor, Tensor]:
    """function(*primals) and its derivative along `tangents` (None: constant), both without gradient."""
    with torch.no_grad(), forward_ad.dual_level():
        duals = (
            x if tangent is None else forward_ad.make_dual(x, tangent)
            for x, tangent in zip(primals, tangents, strict=True)
        )
        output = forward_ad.unpack_dual(function(*duals))
        tangent = torch.zeros_like(output.primal) if output.tangent is None else output.tangent
        return output.primal, tangent
