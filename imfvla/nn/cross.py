"""A core whose action tokens look the context up by cross-attention, as Diffusion Policy's transformer does.

Context tokens keep what the encoder gave them: each block has its own keys and values of them, computed once per
observation.

Shapes: B batch, L context tokens, D width.
"""

from torch import Tensor, nn
from torch.nn import functional as F

from imfvla.nn.attention import Attention, CrossAttention, KeyValue
from imfvla.nn.dual import LayerNorm
from imfvla.nn.residual import History
from imfvla.nn.transformer import Conditioning, SwiGLU, TransformerCore


class CrossBlock(nn.Module):
    """Self-attention, cross-attention to the context and an MLP, each a sublayer with its pre-norm."""

    num_sublayers = 3

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm = LayerNorm(width, elementwise_affine=False)
        self.attention = Attention(width, heads)
        self.cross_attention = CrossAttention(width, heads)
        self.mlp = SwiGLU(width, int(mlp_ratio * width))

    def forward(self, history: History, context: KeyValue) -> None:
        """Adds the increments of the three sublayers."""
        history.add(self.attention(self.norm(history.read())))
        history.add(self.cross_attention(self.norm(history.read()), context))
        history.add(self.mlp(self.norm(history.read())))


class CrossAttentionCore(TransformerCore):
    """Time and action tokens attend to each other, then to the context; the rest as in `TransformerCore`."""

    block = CrossBlock

    def drop_context(self) -> None:
        super().drop_context()
        for block in self.blocks:
            del block.cross_attention.key_value

    def condition(self, context: Tensor) -> Conditioning:
        """Keys and values of the context tokens (B, L, D), of which the last one is a summary, for every block."""
        tokens = F.layer_norm(context, context.shape[-1:])
        cached = tuple(block.cross_attention.project(tokens) for block in self.blocks)
        return Conditioning(cached, self.summary(context[:, -1]))
