"""The observation encoder: pictures, robot state and instruction to context tokens.

Shapes: B batch, To observed steps, V views, S state, D width, L tokens.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from imfvla.encoders.vision import in_unit_range
from imfvla.nn.normaliser import Normaliser
from imfvla.types import NUM_WORD_IDS, Observation

MIN_STATE_SCALE = 5e-3  # in the unit of the channel: rad, m, a share of an opening


class ObservationEncoder(nn.Module):
    """Context tokens (B, L, width): views and state of each step, one for the sentence, one that summarises them all.

    L = To * (V * tokens + 1) + 2, with `tokens` of each view. All views of all steps run through the trunk `vision` as
    one batch; `view_tokens` builds what turns its maps into tokens from (views, channels, grid, width). The summary
    comes last: the core hands it to every action token, before any attention is learnt.
    """

    last_token = "summary"
    state_token = -3  # of the last step; the sentence and the summary follow

    def __init__(
        self,
        *,
        vision: nn.Module,
        views: int,
        observed_steps: int,
        state_dim: int,
        width: int,
        image_size: tuple[int, int],
        view_tokens: Callable[..., nn.Module],
    ) -> None:
        super().__init__()
        self.vision = vision.to(memory_format=torch.channels_last)
        grid = tuple(math.ceil(pixels / vision.stride) for pixels in image_size)
        self.view_tokens = view_tokens(views=views, channels=vision.channels, grid=grid, width=width)
        self.state_normaliser = Normaliser(state_dim)
        self.state = nn.Sequential(nn.Linear(state_dim, width), nn.SiLU(), nn.Linear(width, width))
        self.words = nn.EmbeddingBag(NUM_WORD_IDS, width, mode="mean", padding_idx=0)
        num_tokens = observed_steps * (views * self.view_tokens.tokens + 1) + 1
        self.summary = nn.Linear(num_tokens * width, width)
        self.step_identity = nn.Parameter(0.02 * torch.randn(observed_steps, 1, width))

    def fit(self, low: Tensor, high: Tensor) -> None:
        """Takes the range of the states (S,), which is stretched to [-1, 1]."""
        self.state_normaliser.fit((low + high) / 2, (high - low) / 2, MIN_STATE_SCALE)

    def forward(self, obs: Observation) -> Tensor:
        batch, steps, views = obs.images.shape[:3]
        pixels = obs.images.flatten(0, 2).contiguous(memory_format=torch.channels_last)
        features = self.vision(in_unit_range(pixels))
        seen = self.view_tokens(features.unflatten(0, (batch * steps, views)))
        state = self.state(self.state_normaliser.normalise(obs.state)).flatten(0, 1).unsqueeze(1)
        tokens = torch.cat((seen, state), dim=1).unflatten(0, (batch, steps)) + self.step_identity
        sentence = self.words(obs.instruction).unsqueeze(1)
        tokens = torch.cat((tokens.flatten(1, 2), sentence), dim=1)
        return torch.cat((tokens, self.summary(tokens.flatten(1)).unsqueeze(1)), dim=1)
