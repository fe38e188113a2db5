"""How a deep stack hands earlier results to later sublayers: a fixed sum, or Attention Residuals.

A sublayer is one attention or one MLP with its own pre-norm. Its output is the increment y_l; y_0 is the embedding.
A residual decides what sublayer l + 1 reads (paper eq. 10 or eq. 12) and what the stack returns at its end.

Shapes: B batch, T tokens, D width.
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from imfvla.nn.forward_mode import affine


class History(Protocol):
    """The increments of one forward pass, as its residual keeps them."""

    def read(self) -> Tensor:
        """Input (B, T, D) of the next sublayer."""
        ...

    def add(self, increment: Tensor) -> None:
        """Takes the output (B, T, D) of the sublayer that read last."""
        ...

    def readout(self) -> Tensor:
        """What the stack returns (B, T, D), before the final norm."""
        ...


class StandardResidual(nn.Module):
    """x_l = x_{l-1} + y_l (paper eq. 8)."""

    def __init__(self, num_sublayers: int, width: int) -> None:
        super().__init__()

    def begin(self, embedding: Tensor) -> History:
        return _Sum(embedding)


class _Sum:
    def __init__(self, embedding: Tensor) -> None:
        self.total = embedding

    def read(self) -> Tensor:
        return self.total

    def add(self, increment: Tensor) -> None:
        self.total = self.total + increment

    readout = read


class AttentionResidual(nn.Module):
    """Depth-wise attention over all earlier increments (paper eq. 12-14; arXiv 2603.15031).

    Sublayer l reads sum_s a_{l,s} y_s with a_{l,s} = softmax_s(w_l . RMSNorm(y_s)), per token. The queries w_l start
    at zero: every increment counts alike at first, which after the pre-norm equals the standard residual. No gate
    beside them starts at zero, since keys of zero would starve the queries of gradient.

    `readout`: "sum" returns sum_s y_s (paper eq. 13), "attn" one more aggregation with a query of its own (2603.15031).
    """

    def __init__(self, num_sublayers: int, width: int, readout: str = "sum") -> None:
        super().__init__()
        if readout not in ("sum", "attn"):
            raise ValueError(f"readout must be 'sum' or 'attn', found {readout!r}")
        self.readout_kind = readout
        self.num_sublayers = num_sublayers
        self.eps: Tensor
        self.register_buffer("eps", torch.tensor(1e-6), persistent=False)
        self.query = nn.Parameter(torch.zeros(num_sublayers + (readout == "attn"), width))

    def begin(self, embedding: Tensor) -> History:
        history = _Increments(self)
        history.add(embedding)
        return history

    def scores(self, increment: Tensor) -> Tensor:
        """w_l . RMSNorm(y) for the queries of all sublayers at once: (B, T, D) -> (B, T, number of queries)."""
        mean_square = affine(increment.square().mean(-1, keepdim=True), None, self.eps)
        return affine(increment, self.query.T) * mean_square.rsqrt()


class _Increments:
    def __init__(self, residual: AttentionResidual) -> None:
        self.residual = residual
        self.increments: list[Tensor] = []
        self.scores: list[Tensor] = []

    def add(self, increment: Tensor) -> None:
        self.increments.append(increment)
        self.scores.append(self.residual.scores(increment))

    def weights(self, query: int) -> Tensor:
        """a_{query, s} over the increments s so far, summing to 1: (B, T, s)."""
        return torch.stack(self.scores, dim=-2)[..., query].contiguous().softmax(-1)

    def aggregate(self, query: int) -> Tensor:
        if len(self.increments) == 1:
            return self.increments[0]
        return (self.weights(query).unsqueeze(-2) @ torch.stack(self.increments, dim=-2)).squeeze(-2)

    def read(self) -> Tensor:
        return self.aggregate(len(self.increments) - 1)

    def readout(self) -> Tensor:
        if self.residual.readout_kind == "attn":
            return self.aggregate(self.residual.num_sublayers)
        return torch.stack(self.increments).sum(0)
