"""The linear layer of everything that is differentiated forward."""

from torch import Tensor, nn

from imfvla.nn.forward_mode import product


class Linear(nn.Linear):
    """nn.Linear whose weights count as constants in forward mode; the same parameters, values and gradients."""

    def forward(self, x: Tensor) -> Tensor:
        y = product(x, self.weight.T)
        return y if self.bias is None else y + self.bias
