"""How large a policy may become while it is built: a config from elsewhere can name any numbers."""

import math
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from imfvla.errors import UserError

MAX_PARAMETERS = 2 * 10**9
_FACTORIES = (torch.empty, torch.zeros, torch.ones, torch.rand, torch.randn, torch.full)


class SizeBudget(TorchFunctionMode):
    """Inside, tensors that are made may have `MAX_PARAMETERS` numbers in all. Raises UserError before more are made."""

    def __init__(self) -> None:
        super().__init__()
        self._made = 0

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func in _FACTORIES:
            size = kwargs.get("size", args[0] if args and not isinstance(args[0], int) else args)
            self._made += math.prod(size)
            if self._made > MAX_PARAMETERS:
                raise UserError(
                    f"the configured policy has more than {MAX_PARAMETERS:.0e} parameters: lower the widths and depths "
                    "of encoder and core."
                )
        return func(*args, **kwargs)
