"""ACT's network: a style encoder for training, a transformer encoder and a decoder with learned queries.

After arXiv 2304.13705: post-norm layers with ReLU and dropout; the style is one more token of the encoder.

Shapes: B batch, L context tokens, H steps, A channels, D width, Z style width.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.nn.sizes import LAYERS, WIDTH
from imfvla.options import above, at_least, within


class ActCore(nn.Module):
    """Maps a context and a style to a sequence: (context, style) -> (B, H, A).

    `state_token` is the index of the state among the context tokens: all of a chunk's circumstances that the style
    encoder sees. Raises UserError where `heads` does not divide `width`.
    """

    interface = "style"
    last_token = "summary"  # of the context

    def __init__(
        self,
        *,
        steps: Annotated[int, at_least(1)],
        channels: Annotated[int, at_least(1)],
        width: Annotated[int, WIDTH],
        heads: Annotated[int, WIDTH],
        depth: Annotated[int, LAYERS],
        decoder_depth: Annotated[int, LAYERS],
        style_depth: Annotated[int, LAYERS],
        style_width: Annotated[int, WIDTH],
        state_token: int,
        mlp_ratio: Annotated[float, above(0)],
        dropout: Annotated[float, within(0, 1)],
    ) -> None:
        super().__init__()
        if width % heads:
            raise UserError(f"core.heads must divide core.width={width}, found {heads}.")
        layer = (width, heads, int(mlp_ratio * width), dropout)
        self.width = width
        self.state_token = state_token
        self.style_width = style_width

        self.input = nn.Linear(channels, width)
        self.style_token = nn.Parameter(0.02 * torch.randn(width))
        self.style_positions = nn.Parameter(0.02 * torch.randn(steps, width))
        self.style_encoder = _encoder(layer, style_depth)
        self.style_output = nn.Linear(width, 2 * style_width)

        self.style_input = nn.Linear(style_width, width)
        self.encoder = _encoder(layer, depth)
        self.queries = nn.Parameter(torch.randn(steps, width))
        self.decoder = nn.TransformerDecoder(
            nn.TransformerDecoderLayer(*layer, batch_first=True), decoder_depth, nn.LayerNorm(width)
        )
        self.output = nn.Linear(width, channels)

    def condition(self, context: Tensor) -> Tensor:
        """The context tokens (B, L, D) themselves: the style, one of the encoder's tokens, is not known yet."""
        return context

    def style(self, context: Tensor, actions: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance (B, Z) of the style of chunks (B, H, A) whose steps are `valid` (B, H)."""
        batch = len(actions)
        summary = self.style_token.expand(batch, 1, -1)
        state = context[:, self.state_token].unsqueeze(1)
        tokens = torch.cat((summary, state, self.input(actions) + self.style_positions), dim=1)
        padding = torch.cat((valid.new_zeros(batch, 2), ~valid), dim=1)
        encoded = self.style_encoder(tokens, src_key_padding_mask=padding)
        mean, log_variance = self.style_output(encoded[:, 0]).chunk(2, dim=-1)
        return mean, log_variance

    def forward(self, context: Tensor, style: Tensor) -> Tensor:
        """Context tokens (B, L, D) and styles (B, Z) -> (B, H, A)."""
        memory = self.encoder(torch.cat((context, self.style_input(style).unsqueeze(1)), dim=1))
        return self.output(self.decoder(self.queries.expand(len(context), -1, -1), memory))


def _encoder(layer: tuple[int, int, int, float], depth: int) -> nn.TransformerEncoder:
    return nn.TransformerEncoder(
        nn.TransformerEncoderLayer(*layer, batch_first=True), depth, enable_nested_tensor=False
    )
