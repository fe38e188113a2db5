"""A compact vision-language prefix: patches of all views, the words of the sentence and the robot's state as tokens.

After SmolVLA (arXiv 2506.01844). The layers in which these tokens attend to each other belong to `nn/smolvla.py`,
whose action expert reads each of them.

Shapes: B batch, To observed steps, V views, S state, W words, D width, L tokens.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from imfvla.encoders.vision import in_unit_range
from imfvla.nn.normaliser import Normaliser
from imfvla.nn.pretrained import Backbone
from imfvla.types import MAX_WORDS, NUM_WORD_IDS, Observation

MIN_STATE_SCALE = 5e-3  # in the unit of the channel: rad, m, a share of an opening


class TextEncoder(nn.Module):
    """Words in their sentence: ids (B, W) -> (B, W, D), by embeddings, positions and self-attention.

    No word attends to a place without a word; such places become one learned token.
    """

    def __init__(self, width: int, heads: int, depth: int, mlp_ratio: float) -> None:
        super().__init__()
        self.words = nn.Embedding(NUM_WORD_IDS, width)
        self.positions = nn.Parameter(0.02 * torch.randn(MAX_WORDS, width))
        self.empty_token = nn.Parameter(0.02 * torch.randn(width))
        layer = nn.TransformerEncoderLayer(
            width, heads, int(mlp_ratio * width), dropout=0.0, batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerEncoder(layer, depth, enable_nested_tensor=False)

    def forward(self, ids: Tensor) -> Tensor:
        empty = ids == 0
        hidden = empty.clone()
        hidden[:, 0] = False  # a sentence without words has something to attend to
        encoded = self.layers(self.words(ids) + self.positions, src_key_padding_mask=hidden)
        return torch.where(empty.unsqueeze(-1), self.empty_token.to(encoded.dtype), encoded)


class VisionLanguageEncoder(Backbone, nn.Module):
    """Context tokens (B, L, width): patches of all views of all steps, words, and the last state at the end.

    `view_tokens` builds what turns the maps of `vision` into tokens from (views, channels, grid, width).
    pretrained: a safetensors file with the weights of all but the state's projection, under the names that a policy's
      checkpoint gives them; None for random ones.
    frozen: those weights are not trained. Raises UserError if there are none.
    """

    key = "encoder"
    last_token = "state"
    state_token = -1
    own = ("state.", "state_normaliser.")  # what is never pretrained

    def __init__(
        self,
        *,
        vision: nn.Module,
        views: int,
        observed_steps: int,
        state_dim: int,
        width: int,
        heads: int,
        text_depth: int,
        mlp_ratio: float,
        image_size: tuple[int, int],
        view_tokens: Callable[..., nn.Module],
        pretrained: str | None,
        frozen: bool,
    ) -> None:
        super().__init__()
        self.vision = vision.to(memory_format=torch.channels_last)
        grid = tuple(math.ceil(pixels / vision.stride) for pixels in image_size)
        self.view_tokens = view_tokens(views=views, channels=vision.channels, grid=grid, width=width)
        self.text = TextEncoder(width, heads, text_depth, mlp_ratio)
        self.step_identity = nn.Parameter(0.02 * torch.randn(observed_steps, 1, width))
        self.state_normaliser = Normaliser(state_dim)
        self.state = nn.Linear(state_dim, width)
        self.set_backbone(pretrained, frozen)

    def fit(self, low: Tensor, high: Tensor) -> None:
        """Takes the range of the states (S,), which is stretched to [-1, 1]."""
        self.state_normaliser.fit((low + high) / 2, (high - low) / 2, MIN_STATE_SCALE)

    def forward(self, obs: Observation) -> Tensor:
        batch, steps, views = obs.images.shape[:3]
        pixels = obs.images.flatten(0, 2).contiguous(memory_format=torch.channels_last)
        features = self.vision(in_unit_range(pixels))
        seen = self.view_tokens(features.unflatten(0, (batch * steps, views)))
        seen = (seen.unflatten(0, (batch, steps)) + self.step_identity).flatten(1, 2)
        state = self.state(self.state_normaliser.normalise(obs.state[:, -1])).unsqueeze(1)
        return torch.cat((seen, self.text(obs.instruction), state), dim=1)
