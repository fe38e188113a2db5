"""The policy transformer: a prefix of context tokens, and action tokens that see it.

- Context, time and action tokens run through the same weights. Context tokens do not see action tokens, so that
  their keys and values are computed once per observation and serve every flow evaluation, every noise draw and the
  Jacobian-vector product. The last context token, a summary, is also added to every action token.
- Sublayers (attention, SwiGLU) read what the residual hands them, through a pre-norm whose gain is the next layer's.
- Several consecutive steps of the sequence share one token ("patch").
- The output layer starts at zero; nothing else does but the queries of the Attention Residuals.

`nn/cross.py` and `nn/adaln.py` have cores in which the context reaches the action tokens by another way.

Shapes: B batch, H steps, A channels, K = H / patch tokens, L context tokens, D width.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from imfvla.nn.attention import Attention, KeyValue
from imfvla.nn.dual import Dual, LayerNorm, Same, linear_map, shifted, silu_tangent
from imfvla.nn.embeddings import TimeEmbedding
from imfvla.nn.linear import Linear
from imfvla.nn.residual import History
from imfvla.nn.sizes import LAYERS, WIDTH
from imfvla.options import above, at_least


@dataclass(frozen=True, slots=True)
class Conditioning:
    """The context of a batch as a core's `condition` prepares it."""

    blocks: tuple[KeyValue, ...]  # of every block that attends to the context
    summary: Tensor | None = None  # (B, D), of the last context token

    def repeat(self, times: int) -> "Conditioning":
        """Each row `times` times in succession: (B, ...) -> (B * times, ...)."""
        if times == 1:
            return self
        return self.map(lambda x: x.repeat_interleave(times, dim=0))

    def detach(self, dtype: torch.dtype) -> "Conditioning":
        """Without gradient, in the precision `dtype` in which a derivative is taken."""
        return self.map(lambda x: x.detach().to(dtype))

    def rows(self, index: Tensor | slice) -> "Conditioning":
        return self.map(lambda x: x[index] if isinstance(index, slice) else x.index_select(0, index))

    def tensors(self) -> tuple[Tensor, ...]:
        """All of it, in an order that `of` reads: what a graph hands from one call to the next."""
        kept = tuple(tensor for block in self.blocks for tensor in block)
        return kept if self.summary is None else (*kept, self.summary)

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> "Conditioning":
        """Inverse of `tensors`."""
        blocks = tuple(zip(tensors[0::2], tensors[1::2], strict=False))
        return cls(blocks, tensors[-1] if len(tensors) % 2 else None)

    def map(self, function: Callable[[Tensor], Tensor]) -> "Conditioning":
        blocks = tuple((function(keys), function(values)) for keys, values in self.blocks)
        return Conditioning(blocks, None if self.summary is None else function(self.summary))


class SwiGLU(nn.Module):
    """W_out (silu(a) * b), (a, b) = W_in x (arXiv 2002.05202)."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.input = Linear(width, 2 * hidden, bias=False)
        self.output = Linear(hidden, width, bias=False)

    def forward(self, x: Same) -> Same:
        return self.output(gated(self.input(x)))


def gated(x: Same) -> Same:
    """silu(a) * b of x = (a, b): (..., 2 H) -> (..., H)."""
    if isinstance(x, Dual):
        return x.tape.add(gated(x.value), lambda tangent: _gated_tangent(tangent, x.fixed), x)
    a, b = x.chunk(2, dim=-1)
    return F.silu(a) * b


def _gated_tangent(tangent: Tensor, x: Tensor) -> Tensor:
    (da, db), (a, b) = tangent.chunk(2, dim=-1), x.chunk(2, dim=-1)
    return torch.addcmul(silu_tangent(da, a) * b, F.silu(a), db)


class Block(nn.Module):
    """One attention and one MLP sublayer, each with its pre-norm."""

    num_sublayers = 2

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.attention_norm = LayerNorm(width, elementwise_affine=False)
        self.attention = Attention(width, heads)
        self.mlp_norm = LayerNorm(width, elementwise_affine=False)
        self.mlp = SwiGLU(width, int(mlp_ratio * width))

    def forward(self, history: History[Same], prefix: KeyValue) -> None:
        """Adds the increments of both sublayers, whose tokens see the prefix and each other."""
        history.add(self.attention(self.attention_norm(history.read()), prefix))
        history.add(self.mlp(self.mlp_norm(history.read())))


@torch.no_grad()
def copy_weights(source: nn.Module, target: nn.Module) -> None:
    """The parameters of `target` take the values of those of `source` with the same names."""
    learned = dict(source.named_parameters())
    for name, parameter in target.named_parameters():
        parameter.copy_(learned[name])


class TransformerCore(nn.Module):
    """Maps a noisy sequence, its times and a context to a sequence: (x, t, r | context) -> (B, H, A).

    `residual` builds the residual from (num_sublayers, width), as the classes of `nn/residual.py` do.
    `max_rad` is the highest frequency of the time embeddings. With `velocity_head` average and instantaneous velocity
    share the context and have action blocks each of their own (the auxiliary head of arXiv 2512.02012).
    Raises ValueError where `patch` does not divide `steps`.
    """

    block: type[nn.Module] = Block
    takes_duals = True  # a subclass with layers that take none says no
    last_token = "summary"  # of the context

    def __init__(
        self,
        *,
        steps: Annotated[int, at_least(1)],
        channels: Annotated[int, at_least(1)],
        width: Annotated[int, WIDTH],
        depth: Annotated[int, LAYERS],
        heads: Annotated[int, WIDTH],
        patch: Annotated[int, at_least(1)],
        mlp_ratio: Annotated[float, above(0)],
        max_rad: Annotated[float, above(0)],
        residual: Callable[[int, int], nn.Module],
        velocity_head: bool = False,
    ) -> None:
        super().__init__()
        if steps % patch:
            raise ValueError(f"core.patch must divide the {steps} steps of horizon.pred, found {patch}")
        self.steps, self.channels, self.width, self.patch = steps, channels, width, patch
        self.input = Linear(patch * channels, width)
        self.summary = Linear(width, width)
        self.position = nn.Parameter(0.02 * torch.randn(steps // patch, width))
        self.time = TimeEmbedding(width, max_rad)
        self.interval = TimeEmbedding(width, max_rad)
        self.blocks = nn.ModuleList(self.block(width, heads, mlp_ratio) for _ in range(depth))
        self.residual = residual(self.block.num_sublayers * depth, width)
        self.norm = LayerNorm(width, elementwise_affine=False)
        self.output = Linear(width, patch * channels)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)
        self.add_layers()
        self.interface = "flow and v-head" if velocity_head else "flow"
        self.average: TransformerCore | None = None
        if velocity_head:
            self.average = copy.deepcopy(self)
            self.average.drop_context()

    def add_layers(self) -> None:
        """Layers of a subclass, which the average velocity has too."""

    def drop_context(self) -> None:
        """Takes away what prepares the context: the average velocity reads the one of the other blocks."""
        del self.summary

    def condition(self, context: Tensor) -> Conditioning:
        """Runs the context tokens (B, L, D), of which the last one is a summary, through the stack once."""
        history = self.residual.begin(context)
        cached = []
        for block in self.blocks:
            queries, own = block.attention.project(block.attention_norm(history.read()))
            cached.append(own)
            if block is self.blocks[-1]:
                break  # nothing reads the context tokens after the last keys and values
            history.add(block.attention.attend(queries, own))
            history.add(block.mlp(block.mlp_norm(history.read())))
        return Conditioning(tuple(cached), self.summary(context[:, -1]))

    def forward(self, x: Same, t: Same, r: Same, context: Conditioning) -> Same:
        """x (B, H, A), times 0 <= r <= t <= 1 (B,), context of the same B -> (B, H, A)."""
        stack = self.average or self
        return stack.sequence(stack.output(stack.features(x, t, r, context)))

    def instant(self, x: Same, t: Same, context: Conditioning) -> Same:
        """What the blocks of the instantaneous velocity say, r = t: x (B, H, A), t (B,) -> (B, H, A)."""
        return self.sequence(self.output(self.features(x, t, t, context)))

    def start_average(self) -> None:
        """The blocks of the average velocity take the weights of those of the instantaneous one."""
        copy_weights(self, self.average)

    def features(self, x: Same, t: Same, r: Same, context: Conditioning) -> Same:
        """What the output layers read of each action token: (B, K, D)."""
        tokens = shifted(self.patches(x), self.position + context.summary.unsqueeze(1))
        sequence = linear_map(_in_a_row, self.time(t), self.interval(t - r), tokens)
        history = self.residual.begin(sequence)
        for block, prefix in zip(self.blocks, context.blocks, strict=True):
            block(history, prefix)
        return self.norm(history.readout()[:, 2:])

    def patches(self, x: Same) -> Same:
        """Tokens (B, K, D) of a sequence (B, H, A)."""
        return self.input(linear_map(lambda x: x.unflatten(1, (-1, self.patch)).flatten(2), x))

    def sequence(self, patches: Same) -> Same:
        """The sequence (B, H, A) whose patches are (B, K, patch * A)."""
        return linear_map(lambda x: x.unflatten(-1, (self.patch, self.channels)).flatten(1, 2), patches)


def _in_a_row(time: Tensor, interval: Tensor, tokens: Tensor) -> Tensor:
    """(B, D), (B, D) and (B, K, D) -> (B, 2 + K, D)."""
    return torch.cat((time.unsqueeze(1), interval.unsqueeze(1), tokens), dim=1)
