"""Multi-head attention from plain matrix products, so that a derivative passes through it.

PyTorch's fused attention kernels have no forward-mode derivative; the explicit form is exact and, at the short
sequences of a policy, quicker. Cached keys and values of a prefix are put before a sequence's own, so that one product
makes all scores.

Shapes: B batch, L queries, P prefix or context tokens, D width, N heads, E width of a head.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from imfvla.nn.dual import Dual, Same, linear_map, look_up, softmax_tangent
from imfvla.nn.linear import Linear

KeyValue = tuple[Tensor, Tensor]  # keys (B, N, E, P), transposed for the product, and values (B, N, P, E)


def head_width(width: int, heads: int) -> int:
    """E. Raises ValueError where `heads` does not divide `width`."""
    if width % heads:
        raise ValueError(f"width {width} is not divisible by {heads} heads")
    return width // heads


def split_heads(x: Same, heads: int) -> Same:
    """(B, L, N * E) -> (B, N, L, E)."""
    return linear_map(lambda x: x.unflatten(-1, (heads, -1)).transpose(1, 2), x)


def join_heads(x: Same) -> Same:
    """(B, N, L, E) -> (B, L, N * E)."""
    return linear_map(lambda x: x.transpose(1, 2).flatten(2), x)


class Attention(nn.Module):
    """Self-attention whose queries also see the cached keys and values of a prefix that does not see them.

    `inner` is the width N * E of all heads together, `width` where it is not given.
    """

    def __init__(self, width: int, heads: int, inner: int | None = None) -> None:
        super().__init__()
        inner = inner or width
        scale = head_width(inner, heads) ** -0.5
        self.heads = heads
        self.query_key_value = Linear(width, 3 * inner, bias=False)
        with torch.no_grad():  # the usual scale of the scores, as part of the queries' weights
            self.query_key_value.weight[:inner] *= scale
        self.output = Linear(inner, width, bias=False)

    def project(self, x: Tensor) -> tuple[Tensor, KeyValue]:
        """Queries (B, N, L, E), and the keys and values of x (B, L, D)."""
        return self._heads(self.query_key_value(x))

    def attend(
        self, q: Tensor, own: KeyValue, prefix: KeyValue | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Attention output (B, L, D) of the queries over prefix and own tokens.

        `mask` (L, L) is added to the scores of own tokens: -inf where a query (row) does not see a token (column).
        """
        keys, values = _joined(own, prefix)
        return self.output(join_heads(_weights(q, keys, mask) @ values))

    def forward(self, x: Same, prefix: KeyValue | None = None, mask: Tensor | None = None) -> Same:
        if isinstance(x, Dual):
            return self.output(self._mixed(self.query_key_value(x), prefix, mask))
        q, own = self.project(x)
        return self.attend(q, own, prefix, mask)

    def _heads(self, qkv: Tensor) -> tuple[Tensor, KeyValue]:
        q, k, v = qkv.unflatten(-1, (3, self.heads, -1)).unbind(-3)
        return q.transpose(1, 2), (k.permute(0, 2, 3, 1), v.transpose(1, 2))

    def _mixed(self, qkv: Dual, prefix: KeyValue | None, mask: Tensor | None) -> Dual:
        """What is attended to, (B, L, N * E), of queries, keys and values together."""
        q, own = self._heads(qkv.value)
        keys, values = _joined(own, prefix)
        weights = _weights(q, keys, mask)
        num_own, rows = q.shape[2], qkv.tape.rows
        kept = [x.detach() for x in (q, keys, values, weights)]

        def rule(tangent: Tensor) -> Tensor:
            q, keys, values, weights = (x[rows] for x in kept)
            dq, (dk, dv) = self._heads(tangent)
            scores = dq @ keys
            scores[..., -num_own:] += q @ dk
            mixed = softmax_tangent(scores, weights) @ values + weights[..., -num_own:] @ dv
            return join_heads(mixed)

        return qkv.tape.add(join_heads(weights @ values), rule, qkv)


def _joined(own: KeyValue, prefix: KeyValue | None) -> KeyValue:
    """Keys and values of the prefix and, behind them, a sequence's own."""
    if prefix is None:
        return own
    return torch.cat((prefix[0], own[0]), dim=3), torch.cat((prefix[1], own[1]), dim=2)


def _weights(q: Tensor, keys: Tensor, mask: Tensor | None) -> Tensor:
    """Weights (B, N, L, P + L) of the queries; the mask (L, L) is of own tokens."""
    scores = q @ keys
    if mask is not None:
        scores = scores + F.pad(mask, (keys.shape[-1] - mask.shape[-1], 0))
    return scores.softmax(-1)


class CrossAttention(nn.Module):
    """Attention to the cached keys and values of a context, which a derivative takes for constants."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        scale = head_width(width, heads) ** -0.5
        self.heads = heads
        self.query = Linear(width, width, bias=False)
        with torch.no_grad():
            self.query.weight *= scale
        self.key_value = Linear(width, 2 * width, bias=False)
        self.output = Linear(width, width, bias=False)

    def project(self, context: Tensor) -> KeyValue:
        """Keys and values of the context (B, P, D)."""
        keys, values = self.key_value(context).unflatten(-1, (2, self.heads, -1)).unbind(-3)
        return keys.permute(0, 2, 3, 1), values.transpose(1, 2)

    def forward(self, x: Same, context: KeyValue) -> Same:
        """Attention output (B, L, D) of x (B, L, D)."""
        return self.output(join_heads(look_up(split_heads(self.query(x), self.heads), *context)))
