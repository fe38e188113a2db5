"""The linear layer of everything that is differentiated forward."""

import torch
from torch import Tensor, nn

from imfvla.nn.forward_mode import affine


class Linear(nn.Linear):
    """nn.Linear whose weights count as constants in forward mode; the same parameters, values and gradients."""

    def forward(self, x: Tensor) -> Tensor:
        if torch.is_autocast_enabled(
            x.device.type
        ):  # which casts a weight once, but its transpose at every use
            return super().forward(x)
        return affine(x, self.weight.T, self.bias)
