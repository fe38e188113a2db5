"""Multi-head attention from plain matrix products, so that forward-mode differentiation passes through it.

PyTorch's fused attention kernels have no forward-mode derivative; the explicit form is exact and, at the short
sequences of a policy, as quick.

Shapes: B batch, L queries, P prefix or context tokens, D width, N heads, E width of a head.
"""

import torch
from torch import Tensor, nn

from imfvla.nn.forward_mode import affine
from imfvla.nn.linear import Linear

KeyValue = tuple[Tensor, Tensor]  # keys (B, N, E, P), transposed for the product, and values (B, N, P, E)


def head_width(width: int, heads: int) -> int:
    """E. Raises ValueError where `heads` does not divide `width`."""
    if width % heads:
        raise ValueError(f"width {width} is not divisible by {heads} heads")
    return width // heads


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
        q, k, v = self.query_key_value(x).unflatten(-1, (3, self.heads, -1)).unbind(-3)
        return q.transpose(1, 2), (k.permute(0, 2, 3, 1), v.transpose(1, 2))

    def attend(
        self, q: Tensor, own: KeyValue, prefix: KeyValue | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Attention output (B, L, D) of the queries over prefix and own tokens.

        `mask` (L, L) is added to the scores of own tokens: -inf where a query (row) does not see a token (column).
        """
        keys, values = own
        scores = q @ keys
        if mask is not None:
            scores = affine(scores, None, mask)
        if prefix is None:
            mixed = scores.softmax(-1) @ values
        else:
            # One softmax over two score blocks: cheaper than concatenating the cached keys and values each time.
            num_prefix = prefix[0].shape[-1]
            weights = torch.cat((affine(q, prefix[0]), scores), dim=-1).softmax(-1)
            mixed = affine(weights[..., :num_prefix], prefix[1]) + weights[..., num_prefix:] @ values
        return self.output(mixed.transpose(1, 2).flatten(2))

    def forward(self, x: Tensor, prefix: KeyValue | None = None, mask: Tensor | None = None) -> Tensor:
        q, own = self.project(x)
        return self.attend(q, own, prefix, mask)


class CrossAttention(nn.Module):
    """Attention to the cached keys and values of a context, which forward mode takes for constants."""

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

    def forward(self, x: Tensor, context: KeyValue) -> Tensor:
        """Attention output (B, L, D) of x (B, L, D)."""
        keys, values = context
        queries = self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        mixed = affine(affine(queries, keys).softmax(-1), values)
        return self.output(mixed.transpose(1, 2).flatten(2))
