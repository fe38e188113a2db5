"""Dual numbers: values that a network computes as usual, and tangents that follow from them later.

A core that is called with `Dual` inputs computes its values in one ordinary pass, under autograd like any other. Each
layer leaves a rule on the `Tape`: how a change of its input changes its output, from the values of that pass. `push`
then runs the rules for a direction. The direction may thus come from the same pass, and only some rows have one.

No rule takes part in autograd: a tangent is without gradient. Nothing is spent on constants (weights, the cached
context), and softmax and layer norm, whose Jacobians are symmetric, are served by PyTorch's kernels for the backward
pass. `nn/forward_mode.py` has PyTorch's own derivative, which the tests compare with.

Shapes: B batch; of the tangents the first dimension has the tape's rows alone.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Rows = slice | Tensor
Rule = Callable[..., Tensor]  # tangents of the parents -> tangent


class Tape:
    """The rules of one pass in their order. `rows` of the batch have tangents."""

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self._rules: list[tuple[Dual, Rule, tuple[Dual, ...]]] = []

    def input(self, value: Tensor) -> "Dual":
        """An input of the pass."""
        return Dual(value, self)

    def add(self, value: Tensor, rule: Rule, *parents: "Dual") -> "Dual":
        """What a layer gives of `parents`: its value, and the rule for its tangent."""
        made = Dual(value, self)
        self._rules.append((made, rule, parents))
        return made

    def push(self, output: "Dual", *directions: tuple["Dual", Tensor]) -> Tensor:
        """The tangent of `output` where each input has the tangent beside it. Works once: the tape is used up."""
        for dual, tangent in directions:
            dual.tangent = tangent
        rules, self._rules = self._rules, []
        with torch.no_grad():
            for made, rule, parents in rules:
                made.tangent = rule(*[parent.tangent for parent in parents])
        assert output.tangent is not None
        return output.tangent


class Dual:
    """A value of a pass and, once the tape was pushed, the tangent of its rows."""

    __slots__ = ("tangent", "tape", "value")

    def __init__(self, value: Tensor, tape: Tape) -> None:
        self.value, self.tape = value, tape
        self.tangent: Tensor | None = None

    @property
    def fixed(self) -> Tensor:
        """The value that a rule computes with: without gradient, of the tape's rows."""
        return self.value.detach()[self.tape.rows]

    def __add__(self, other: "Dual") -> "Dual":
        return self.tape.add(self.value + other.value, torch.add, self, other)

    def __sub__(self, other: "Dual") -> "Dual":
        return self.tape.add(self.value - other.value, torch.sub, self, other)

    def __mul__(self, other: "Dual") -> "Dual":
        return self.tape.add(
            self.value * other.value,
            lambda mine, theirs: torch.addcmul(mine * other.fixed, self.fixed, theirs),
            self,
            other,
        )

    def __getitem__(self, index: Any) -> "Dual":
        """`index` keeps the first dimension whole."""
        return linear_map(lambda x: x[index], self)


Same = TypeVar("Same", Tensor, Dual)


def as_written() -> AbstractContextManager[Any]:
    """Inside, a compiled core runs eagerly: what was compiled takes no `Dual`s. Code that is compiled whole does."""
    return nullcontext() if torch.compiler.is_compiling() else torch.compiler.set_stance("force_eager")


def linear_map(function: Callable[..., Tensor], *inputs: Same) -> Same:
    """`function` of inputs in all of which it is linear, row by row: a new shape, a concatenation, a sum."""
    duals = [x for x in inputs if isinstance(x, Dual)]
    if not duals:
        return function(*inputs)
    assert len(duals) == len(inputs), "a constant among the inputs would have a tangent of zero"
    return duals[0].tape.add(function(*(x.value for x in duals)), function, *duals)


def shifted(x: Same, constant: Tensor) -> Same:
    """x + constant."""
    if isinstance(x, Dual):
        return x.tape.add(x.value + constant, lambda tangent: tangent, x)
    return x + constant


def elementwise(function: Callable[[Tensor], Tensor], slope: Callable[[Tensor], Tensor], x: Same) -> Same:
    """`function` of each element, whose derivative is `slope`."""
    if isinstance(x, Dual):
        return x.tape.add(function(x.value), lambda tangent: tangent * slope(x.fixed), x)
    return function(x)


def silu(x: Same) -> Same:
    if isinstance(x, Dual):
        return x.tape.add(F.silu(x.value), lambda tangent: silu_tangent(tangent, x.fixed), x)
    return F.silu(x)


def silu_tangent(tangent: Tensor, x: Tensor) -> Tensor:
    return torch.ops.aten.silu_backward(tangent, x)


def softmax_tangent(tangent: Tensor, weights: Tensor) -> Tensor:
    """Of a softmax over the last axis that gave `weights`."""
    return torch._softmax_backward_data(tangent, weights, -1, weights.dtype)


def look_up(queries: Same, keys: Tensor, values: Tensor) -> Same:
    """softmax(Q K) V of queries (B, N, L, E) with constant keys (B, N, E, P) and values (B, N, P, E)."""
    if not isinstance(queries, Dual):
        return (queries @ keys).softmax(-1) @ values
    weights = (queries.value @ keys).softmax(-1)
    rows = queries.tape.rows

    def rule(tangent: Tensor) -> Tensor:
        change = softmax_tangent(tangent @ keys.detach()[rows], weights.detach()[rows])
        return change @ values.detach()[rows]

    return queries.tape.add(weights @ values, rule, queries)


class SiLU(nn.SiLU):
    """nn.SiLU, of `Dual`s too."""

    def forward(self, x: Same) -> Same:
        return silu(x)


class LayerNorm(nn.LayerNorm):
    """nn.LayerNorm over the last axis, of `Dual`s too where it has no gain."""

    def forward(self, x: Same) -> Same:
        if not isinstance(x, Dual):
            return super().forward(x)
        assert self.weight is None, "the tangent of a gain is not written down"
        value, mean, deviation = torch.native_layer_norm(x.value, self.normalized_shape, None, None, self.eps)

        def rule(tangent: Tensor) -> Tensor:
            rows = x.tape.rows
            moments = mean.detach()[rows], deviation.detach()[rows]
            return torch.ops.aten.native_layer_norm_backward(
                tangent.contiguous(),
                x.fixed,
                self.normalized_shape,
                *moments,
                None,
                None,
                [True, False, False],
            )[0]

        return x.tape.add(value, rule, x)


def total(parts: Sequence[Same]) -> Same:
    """The sum of several."""
    result = parts[0]
    for part in parts[1:]:
        result = result + part
    return result
