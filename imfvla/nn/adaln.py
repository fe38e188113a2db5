"""A core that is conditioned through its norms: DiT's adaptive layer norm (arXiv 2212.09748).

One vector, the sum of both time embeddings and the context's summary, gives every sublayer the shift and scale of its
norm and a gate on its increment. Scales and gates start around one, not at zero as in DiT: increments of zero would
leave the queries of Attention Residuals without gradient, and their norm would blow up the first small increments.

Shapes: B batch, H steps, A channels, K action tokens, L context tokens, D width.
"""

import torch
from torch import Tensor, nn

from imfvla.nn.attention import Attention
from imfvla.nn.dual import Dual, LayerNorm, Same, linear_map, shifted, silu
from imfvla.nn.linear import Linear
from imfvla.nn.residual import History
from imfvla.nn.transformer import Conditioning, SwiGLU, TransformerCore


class Modulation(nn.Module):
    """Vectors (B, 1, D) from a condition (B, D), one for each of `starts`, around which it begins."""

    def __init__(self, width: int, starts: tuple[float, ...]) -> None:
        super().__init__()
        self.num_vectors = len(starts)
        self.linear = Linear(width, len(starts) * width)
        with torch.no_grad():
            self.linear.bias.copy_(torch.tensor(starts).repeat_interleave(width))

    def forward(self, condition: Same) -> tuple[Same, ...]:
        vectors = self.linear(condition)
        if isinstance(vectors, Dual):
            return tuple(
                linear_map(lambda x, of=of: self._split(x)[of], vectors) for of in range(self.num_vectors)
            )
        return self._split(vectors)

    def _split(self, vectors: Tensor) -> tuple[Tensor, ...]:
        return vectors.unsqueeze(1).chunk(self.num_vectors, dim=-1)


class AdaptiveBlock(nn.Module):
    """One attention and one MLP sublayer, each with shift and scale behind its norm and a gate at its end."""

    num_sublayers = 2

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm = LayerNorm(width, elementwise_affine=False)
        self.modulation = Modulation(width, 2 * (0.0, 1.0, 1.0))
        self.attention = Attention(width, heads)
        self.mlp = SwiGLU(width, int(mlp_ratio * width))

    def forward(self, history: History[Same], condition: Same) -> None:
        """Adds the increments of both sublayers under the condition (B, D)."""
        vectors = self.modulation(condition)
        for sublayer, (shift, scale, gate) in ((self.attention, vectors[:3]), (self.mlp, vectors[3:])):
            history.add(gate * sublayer(self.norm(history.read()) * scale + shift))


class AdaptiveNormCore(TransformerCore):
    """Action tokens attend to each other alone; the rest as in `TransformerCore`.

    Of the context only the summary counts. It is not added to the tokens, and the times are no tokens.
    """

    block = AdaptiveBlock

    def add_layers(self) -> None:
        self.modulation = Modulation(self.width, (0.0, 1.0))  # of the last norm

    def condition(self, context: Tensor) -> Conditioning:
        """Takes the summary, the last of the context tokens (B, L, D)."""
        return Conditioning((), self.summary(context[:, -1]))

    def features(self, x: Same, t: Same, r: Same, context: Conditioning) -> Same:
        """What the output layers read of each action token: (B, K, D)."""
        condition = silu(shifted(self.time(t) + self.interval(t - r), context.summary))
        history = self.residual.begin(shifted(self.patches(x), self.position))
        for block in self.blocks:
            block(history, condition)
        shift, scale = self.modulation(condition)
        return self.norm(history.readout()) * scale + shift
