"""How a deep stack hands earlier results to later sublayers: a fixed sum, or Attention Residuals.

A sublayer is one attention or one MLP with its own pre-norm. Its output is the increment y_l; y_0 is the embedding.
A residual decides what sublayer l + 1 reads (paper eq. 10 or eq. 12) and what the stack returns at its end.

Shapes: B batch, T tokens, D width.
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
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
        return _Increments(self, embedding)

    def scores(self, source: Tensor) -> Tensor:
        """w_l . RMSNorm(y) for the queries of all sublayers at once: (B, T, D) -> (B, T, number of queries)."""
        mean_square = affine(source.square().mean(-1, keepdim=True), None, self.eps)
        return affine(source, self.query.T) * mean_square.rsqrt()


class BlockAttentionResidual(AttentionResidual):
    """Depth-wise attention over sums of `block_size` consecutive increments (arXiv 2603.15031).

    The sources are the embedding, the sum of each finished block of sublayers and, within a block, the sum so far: a
    deep core keeps and reads num_sublayers / block_size of them. Size 1 is `AttentionResidual`; one block for all
    sublayers is the standard residual with the embedding apart.

    Raises UserError where a block is larger than the stack.
    """

    def __init__(self, num_sublayers: int, width: int, block_size: int, readout: str = "sum") -> None:
        if block_size not in range(1, num_sublayers + 1):
            raise UserError(
                f"core.residual.block_size must be a whole number from 1 to the {num_sublayers} sublayers of the "
                f"core, found {block_size!r}: choose one of these or raise core.depth."
            )
        super().__init__(num_sublayers, width, readout)
        self.block_size = block_size

    def begin(self, embedding: Tensor) -> History:
        return _BlockSums(self, embedding)


class _Increments:
    """Every increment is a source of its own."""

    def __init__(self, residual: AttentionResidual, embedding: Tensor) -> None:
        self.residual = residual
        self.sources = [embedding]
        self.scores = [residual.scores(embedding)]
        self.sublayer = 0  # the next one to read

    def add(self, increment: Tensor) -> None:
        self.sources.append(increment)
        self.scores.append(self.residual.scores(increment))
        self.sublayer += 1

    def weights(self, query: int) -> Tensor:
        """a_{query, s} over the sources s so far, summing to 1: (B, T, s)."""
        return torch.stack(self.scores, dim=-2)[..., query].contiguous().softmax(-1)

    def aggregate(self, query: int) -> Tensor:
        if len(self.sources) == 1:
            return self.sources[0]
        return (self.weights(query).unsqueeze(-2) @ torch.stack(self.sources, dim=-2)).squeeze(-2)

    def read(self) -> Tensor:
        return self.aggregate(self.sublayer)

    def readout(self) -> Tensor:
        if self.residual.readout_kind == "attn":
            return self.aggregate(self.residual.num_sublayers)
        return torch.stack(self.sources).sum(0)


class _BlockSums(_Increments):
    """The last source grows by each increment until its block is full."""

    residual: BlockAttentionResidual

    def add(self, increment: Tensor) -> None:
        if self.sublayer % self.residual.block_size:
            increment = self.sources.pop() + increment
            self.scores.pop()
        super().add(increment)
