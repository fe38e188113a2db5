"""Forward-mode differentiation by PyTorch: for cores that take no `Dual`s, and the reference of those that do."""

import warnings
from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import forward_ad


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
