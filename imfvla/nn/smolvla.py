"""SmolVLA's two stacks: a vision-language prefix, and an action expert that reads it layer by layer.

After arXiv 2506.01844. The prefix runs once per observation; its keys and values serve every step of the flow. The
expert is narrower. Its even layers attend to the prefix's keys and values and, causally, to the actions so far; its
odd layers look those of the prefix up through projections of their own.

Shapes: B batch, L context tokens, H steps, A channels, D width of the prefix, X width of the expert.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from imfvla.nn.attention import Attention, KeyValue, head_width, join_heads, split_heads
from imfvla.nn.dual import LayerNorm, Same, SiLU, linear_map, look_up, shifted
from imfvla.nn.embeddings import TimeEmbedding
from imfvla.nn.linear import Linear
from imfvla.nn.pretrained import Backbone
from imfvla.nn.sizes import LAYERS, WIDTH
from imfvla.nn.transformer import Conditioning, SwiGLU
from imfvla.options import above, at_least


class PrefixLayer(nn.Module):
    """Self-attention and MLP of the context tokens; the state, which comes last, is not seen by the others."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp = SwiGLU(width, int(mlp_ratio * width))

    def project(self, x: Tensor) -> tuple[Tensor, KeyValue]:
        return self.attention.project(self.attention_norm(x))

    def forward(self, x: Tensor, queries: Tensor, own: KeyValue, mask: Tensor) -> Tensor:
        """Tokens (B, L, D) behind the layer, of which `project` gave queries, keys and values; mask (L, L)."""
        x = x + self.attention.attend(queries, own, mask=mask)
        return x + self.mlp(self.mlp_norm(x))


class PrefixEnd(nn.Module):
    """Keys and values of the context tokens in the last layer, behind which nothing reads the tokens themselves."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm = nn.LayerNorm(width)
        self.key_value = Linear(width, 2 * width, bias=False)

    def project(self, x: Tensor) -> KeyValue:
        keys, values = self.key_value(self.attention_norm(x)).unflatten(-1, (2, self.heads, -1)).unbind(-3)
        return keys.permute(0, 2, 3, 1), values.transpose(1, 2)


class JointAttention(Attention):
    """Actions attend to the prefix and to the actions before them, of `steps` in all."""

    def __init__(self, width: int, heads: int, inner: int, steps: int) -> None:
        super().__init__(width, heads, inner)
        self.causal: Tensor
        hidden = torch.full((steps, steps), -torch.inf).triu(1)
        self.register_buffer("causal", hidden, persistent=False)

    def prepare(self, prefix: KeyValue) -> KeyValue:
        return prefix

    def forward(self, x: Same, prefix: KeyValue) -> Same:
        return super().forward(x, prefix, self.causal)


class PrefixAttention(nn.Module):
    """Actions attend to the prefix alone, through keys and values made of the prefix's."""

    def __init__(self, width: int, heads: int, inner: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = Linear(width, inner, bias=False)
        with torch.no_grad():
            self.query.weight *= head_width(inner, heads) ** -0.5
        self.key = Linear(inner, inner, bias=False)
        self.value = Linear(inner, inner, bias=False)
        self.output = Linear(inner, width, bias=False)

    def prepare(self, prefix: KeyValue) -> KeyValue:
        keys, values = prefix[0].permute(0, 3, 1, 2).flatten(2), prefix[1].transpose(1, 2).flatten(2)
        keys = self.key(keys).unflatten(-1, (self.heads, -1)).permute(0, 2, 3, 1)
        return keys, self.value(values).unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def forward(self, x: Same, prefix: KeyValue) -> Same:
        return self.output(join_heads(look_up(split_heads(self.query(x), self.heads), *prefix)))


class ExpertLayer(nn.Module):
    """One attention and one MLP of the action tokens."""

    def __init__(self, attention: nn.Module, width: int, mlp_ratio: float) -> None:
        super().__init__()
        self.attention_norm = LayerNorm(width, elementwise_affine=False)
        self.attention = attention
        self.mlp_norm = LayerNorm(width, elementwise_affine=False)
        self.mlp = SwiGLU(width, int(mlp_ratio * width))

    def forward(self, x: Same, prefix: KeyValue) -> Same:
        """Action tokens (B, H, X) -> (B, H, X)."""
        x = x + self.attention(self.attention_norm(x), prefix)
        return x + self.mlp(self.mlp_norm(x))


class SmolVLACore(Backbone, nn.Module):
    """Maps a noisy sequence, its times and a context to a sequence: (x, t, r | context) -> (B, H, A).

    One action is one token, which holds both times. Prefix and expert are `depth` layers each.
    pretrained: a safetensors file with the weights of the prefix, under the names that a policy's checkpoint gives
      them; None for random ones.
    frozen: the prefix is not trained. Raises UserError where it has no pretrained weights.
    """

    interface = "flow"
    takes_duals = True
    last_token = "state"  # of the context
    key = "core"
    own = ("input.", "mlp.", "position", "time.", "interval.", "blocks.", "output.")

    def __init__(
        self,
        *,
        steps: Annotated[int, at_least(1)],
        channels: Annotated[int, at_least(1)],
        width: Annotated[int, WIDTH],
        expert_width: Annotated[int, WIDTH],
        depth: Annotated[int, LAYERS],
        heads: Annotated[int, WIDTH],
        mlp_ratio: Annotated[float, above(0)],
        max_rad: Annotated[float, above(0)],
        pretrained: str | None,
        frozen: bool,
    ) -> None:
        super().__init__()
        self.steps, self.channels, self.width = steps, channels, width
        self.prefix = nn.ModuleList(PrefixLayer(width, heads, mlp_ratio) for _ in range(depth - 1))
        self.prefix_end = PrefixEnd(width, heads)
        self.input = Linear(channels, expert_width)
        self.time = TimeEmbedding(expert_width, max_rad)
        self.interval = TimeEmbedding(expert_width, max_rad)
        self.mlp = nn.Sequential(
            Linear(3 * expert_width, expert_width), SiLU(), Linear(expert_width, expert_width)
        )
        self.position = nn.Parameter(0.02 * torch.randn(steps, expert_width))
        attentions = (
            PrefixAttention(expert_width, heads, width)
            if layer % 2
            else JointAttention(expert_width, heads, width, steps)
            for layer in range(depth)
        )
        self.blocks = nn.ModuleList(
            ExpertLayer(attention, expert_width, mlp_ratio) for attention in attentions
        )
        self.norm = LayerNorm(expert_width, elementwise_affine=False)
        self.output = Linear(expert_width, channels)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)
        self.set_backbone(pretrained, frozen)

    def condition(self, context: Tensor) -> Conditioning:
        """Runs the context tokens (B, L, D), of which the state is the last, through the prefix once."""
        cached, mask = [], _hide_last(context)
        for layer in self.prefix:
            queries, own = layer.project(context)
            cached.append(own)
            context = layer(context, queries, own, mask)
        cached.append(self.prefix_end.project(context))
        prepared = (block.attention.prepare(own) for block, own in zip(self.blocks, cached, strict=True))
        return Conditioning(tuple(prepared))

    def forward(self, x: Same, t: Same, r: Same, context: Conditioning) -> Same:
        """x (B, H, A), times 0 <= r <= t <= 1 (B,), context of the same B -> (B, H, A)."""
        inputs = linear_map(_with_times, self.input(x), self.time(t), self.interval(t - r))
        tokens = shifted(self.mlp(inputs), self.position)
        for block, prefix in zip(self.blocks, context.blocks, strict=True):
            tokens = block(tokens, prefix)
        return self.output(self.norm(tokens))


def _with_times(x: Tensor, *times: Tensor) -> Tensor:
    """x (B, H, D) beside the times (B, D) of each, the same in all steps: (B, H, 3 D)."""
    return torch.cat((x, *(time.unsqueeze(1).expand(-1, x.shape[1], -1) for time in times)), dim=-1)


def _hide_last(x: Tensor) -> Tensor:
    """Mask (L, L) that hides the last one of the tokens (B, L, D) from the others."""
    mask = x.new_zeros(x.shape[1], x.shape[1])
    mask[:-1, -1] = -torch.inf
    return mask
