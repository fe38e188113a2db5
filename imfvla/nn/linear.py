"""The linear layer of everything that is differentiated forward."""

from torch import Tensor, nn

from imfvla.nn.forward_mode import affine


class Linear(nn.Linear):
    """nn.Linear whose weights count as constants in forward mode; the same parameters, values and gradients."""

    def forward(self, x: Tensor) -> Tensor:
        return affine(x, self.weight.T, self.bias)
