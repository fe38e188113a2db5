"""The linear layer of everything that is differentiated forward."""

from torch import nn

from imfvla.nn.dual import Dual, Same


class Linear(nn.Linear):
    """nn.Linear, of `Dual`s too: the tangent costs one product with the weights."""

    def forward(self, x: Same) -> Same:
        if not isinstance(x, Dual):
            return super().forward(x)
        return x.tape.add(super().forward(x.value), lambda tangent: tangent @ self.weight.detach().T, x)
