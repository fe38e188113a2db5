"""How a deep stack hands earlier results to later sublayers: a fixed sum, or Attention Residuals.

A sublayer is one attention or one MLP with its own pre-norm. Its output is the increment y_l; y_0 is the embedding.
A residual decides what sublayer l + 1 reads (paper eq. 10 or eq. 12) and what the stack returns at its end.

Shapes: B batch, T tokens, D width.
"""

from typing import Protocol, TypeVar

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.nn.depth import attend_to_depth, depth_mean, depth_scores, depth_weights
from imfvla.nn.dual import Dual, Same, total

Kept = TypeVar("Kept", Tensor, Dual)


class History(Protocol[Kept]):
    """The increments of one forward pass, as its residual keeps them."""

    def read(self) -> Kept:
        """Input (B, T, D) of the next sublayer."""
        ...

    def add(self, increment: Kept) -> None:
        """Takes the output (B, T, D) of the sublayer that read last."""
        ...

    def readout(self) -> Kept:
        """What the stack returns (B, T, D), before the final norm."""
        ...


class StandardResidual(nn.Module):
    """x_l = x_{l-1} + y_l (paper eq. 8)."""

    def __init__(self, num_sublayers: int, width: int) -> None:
        super().__init__()

    def begin(self, embedding: Same) -> History[Same]:
        return _Sum(embedding)


class _Sum:
    def __init__(self, embedding: Same) -> None:
        self.total = embedding

    def read(self) -> Same:
        return self.total

    def add(self, increment: Same) -> None:
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

    def begin(self, embedding: Same) -> History[Same]:
        return _Increments(self, embedding)

    def scores(self, source: Same) -> Same:
        """w_l . RMSNorm(y) for the queries of all sublayers at once: (B, T, D) -> (B, T, number of queries)."""
        return depth_scores(source, self.query, self.eps)


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

    def begin(self, embedding: Same) -> History[Same]:
        return _BlockSums(self, embedding)


class _Increments:
    """Every increment is a source of its own."""

    def __init__(self, residual: AttentionResidual, embedding: Same) -> None:
        self.residual = residual
        self.sources: list[Same] = []
        self.scores: list[Same] = []
        self.columns: list[tuple[Tensor, ...]] = []  # values of the scores by query
        self.sublayer = 0  # the next one to read
        self._append(embedding)

    def add(self, increment: Same) -> None:
        self._append(increment)
        self.sublayer += 1

    def _append(self, source: Same) -> None:
        self.sources.append(source)
        self.scores.append(self.residual.scores(source))
        self.columns.append(_value(self.scores[-1]).unbind(-1))

    def weights(self, query: int) -> Tensor:
        """a_{query, s} over the sources s so far, summing to 1: (B, T, s)."""
        return depth_weights(self.columns, query)

    def aggregate(self, query: int) -> Same:
        if len(self.sources) == 1:
            return self.sources[0]
        if isinstance(self.sources[0], Dual):
            return attend_to_depth(self.scores, self.sources, self.weights(query), query)
        return depth_mean(self.weights(query), self.sources)

    def read(self) -> Same:
        return self.aggregate(self.sublayer)

    def readout(self) -> Same:
        if self.residual.readout_kind == "attn":
            return self.aggregate(self.residual.num_sublayers)
        return total(self.sources)


class _BlockSums(_Increments):
    """The last source grows by each increment until its block is full."""

    residual: BlockAttentionResidual

    def add(self, increment: Same) -> None:
        if self.sublayer % self.residual.block_size:
            increment = self.sources.pop() + increment
            self.scores.pop()
            self.columns.pop()
        super().add(increment)


def _value(x: Same) -> Tensor:
    return x.value if isinstance(x, Dual) else x
