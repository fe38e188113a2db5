"""Attention over depth: what Attention Residuals compute, with gradients and tangents written down.

Stacking all sources for every read copies each of them once a sublayer, and autograd keeps the copies. Here a read adds
its sources up one by one, and its gradient goes to each of them directly.

Shapes: B batch, T tokens, D width, S sources, Q queries.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.linalg import vecdot

from imfvla.nn.dual import Dual, Same, softmax_tangent


def depth_scores(source: Same, queries: Tensor, eps: Tensor) -> Same:
    """w_q . RMSNorm(y) of a source y (B, T, D) for all queries w (Q, D): (B, T, Q)."""
    if isinstance(source, Dual):
        value = depth_scores(source.value, queries, eps)
        return source.tape.add(
            value, lambda tangent: _scores_tangent(tangent, source.fixed, queries.detach(), eps), source
        )
    if torch.is_grad_enabled():
        return _Scores.apply(source, queries, eps)
    return _in_full(source, queries, eps)[1]


def depth_weights(scores: Sequence[tuple[Tensor, ...]], query: int) -> Tensor:
    """Softmax over the sources of their scores for a query: (B, T, S). `scores` has each source's by query, (B, T)."""
    return torch.stack([columns[query] for columns in scores], dim=-1).softmax(-1)


def depth_mean(weights: Tensor, sources: Sequence[Tensor]) -> Tensor:
    """sum_s a_s y_s of weights a (B, T, S) and sources y (B, T, D)."""
    if torch.is_grad_enabled():
        return _Mean.apply(weights, *sources)
    return _mean(weights, sources)


def attend_to_depth(scores: Sequence[Dual], sources: Sequence[Dual], weights: Tensor, query: int) -> Dual:
    """`depth_mean` of `Dual`s whose `weights` for this query come from their scores (B, T, Q)."""
    tape, scores, sources = sources[0].tape, tuple(scores), tuple(sources)  # a history's lists grow

    def rule(*tangents: Tensor) -> Tensor:
        of_scores, of_sources = tangents[: len(scores)], tangents[len(scores) :]
        fixed = weights.detach()[tape.rows]
        change = softmax_tangent(torch.stack([tangent[..., query] for tangent in of_scores], dim=-1), fixed)
        moved = _mean(fixed, of_sources)
        for column, source in zip(_columns(change), sources, strict=True):
            moved.addcmul_(column, source.fixed)
        return moved

    mean = depth_mean(weights, [source.value for source in sources])
    return tape.add(mean, rule, *scores, *sources)


def _columns(weights: Tensor) -> tuple[Tensor, ...]:
    """(B, T, S) -> S times (B, T, 1)."""
    return weights.unsqueeze(-2).unbind(-1)


def _mean(weights: Tensor, sources: Sequence[Tensor]) -> Tensor:
    columns = _columns(weights)
    mean = columns[0] * sources[0]
    for column, source in zip(columns[1:], sources[1:], strict=True):
        mean.addcmul_(column, source)
    return mean


class _Mean(Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, *sources: Tensor) -> Tensor:
        ctx.save_for_backward(weights, *sources)
        return _mean(weights, sources)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        weights, *sources = ctx.saved_tensors
        of_weights = torch.stack([vecdot(gradient, source.to(gradient.dtype)) for source in sources], dim=-1)
        return of_weights, *(column * gradient for column in _columns(weights))


def _scores(source: Tensor, queries: Tensor, eps: Tensor) -> tuple[Tensor, Tensor]:
    """The scores (B, T, Q), and 1 / RMS of the source (B, T, 1), in the precision of the queries."""
    mean_square = vecdot(source, source).unsqueeze(-1) / source.shape[-1]
    scale = (mean_square + eps).rsqrt()
    return (source @ queries.T) * scale, scale


def _in_full(source: Tensor, queries: Tensor, eps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The source and its `_scores`, all in the precision of the queries whatever autocast says."""
    device = source.device.type
    with torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext():
        source = source.to(queries.dtype)
        return source, *_scores(source, queries, eps)


def _scores_tangent(tangent: Tensor, source: Tensor, queries: Tensor, eps: Tensor) -> Tensor:
    scores, scale = _scores(source, queries, eps)
    along = vecdot(source, tangent).unsqueeze(-1) * scale.square() / source.shape[-1]
    return torch.addcmul((tangent @ queries.T) * scale, scores, along, value=-1)


class _Scores(Function):
    @staticmethod
    def forward(ctx: Any, source: Tensor, queries: Tensor, eps: Tensor) -> Tensor:
        source, scores, scale = _in_full(source, queries, eps)
        ctx.save_for_backward(source, queries, scores, scale)
        return scores

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        source, queries, scores, scale = ctx.saved_tensors
        of_product = gradient * scale
        of_queries = of_product.flatten(0, -2).T @ source.flatten(0, -2)
        along = vecdot(gradient, scores).unsqueeze(-1) * scale.square() / source.shape[-1]
        return torch.addcmul(of_product @ queries, along, source, value=-1), of_queries, None
