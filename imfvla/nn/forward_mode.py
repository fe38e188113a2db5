"""Forward-mode differentiation that spends nothing on constants.

PyTorch's own rules treat a constant's missing tangent as an array of zeros: a product with weights costs three
products in place of two, one with a cached context a slow strided one besides, and adding a constant half a
millisecond of dispatch. Here the tangent of x @ matrix + shift is tangent(x) @ matrix.
"""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


class _Affine(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor, matrix: Tensor | None, shift: Tensor | None) -> Tensor:
        return _affine(x, matrix, shift)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor | None, Tensor | None], output: Tensor) -> None:
        ctx.matrix = inputs[1]

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        return tangent.clone() if ctx.matrix is None else tangent @ ctx.matrix


def _affine(x: Tensor, matrix: Tensor | None, shift: Tensor | None) -> Tensor:
    y = x if matrix is None else x @ matrix
    return y if shift is None else y + shift


def affine(x: Tensor, matrix: Tensor | None, shift: Tensor | None = None) -> Tensor:
    """x @ matrix + shift, either of them None for absent, both constants in forward mode."""
    if forward_ad.unpack_dual(x).tangent is None:
        return _affine(x, matrix, shift)
    return _Affine.apply(x, matrix, shift)


def jvp(
    function: Callable[..., Tensor], primals: tuple[Tensor, ...], tangents: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """function(*primals) and its derivative along `tangents`, both without gradient.

    Autocast is off: in bfloat16 the tangent would be off by more than half a percent. So is `torch.compile`, whose
    code would drop the tangent.
    """
    full_precision = torch.autocast(primals[0].device.type, enabled=False)
    eager = torch.compiler.set_stance("force_eager")
    with torch.no_grad(), full_precision, eager, forward_ad.dual_level(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated")  # PyTorch's own use of it
        duals = (forward_ad.make_dual(*pair) for pair in zip(primals, tangents, strict=True))
        output = forward_ad.unpack_dual(function(*duals))
        return output.primal, output.tangent
