"""The observation encoder: pictures, robot state and instruction to context tokens.

Shapes: B batch, To observed steps, V views, S state, D width, L tokens.
"""

import torch
from torch import Tensor, nn

from imfvla.encoders.tokens import ViewTokens
from imfvla.instruction import NUM_WORD_IDS
from imfvla.nn.normaliser import Normaliser
from imfvla.types import Observation

MIN_STATE_SCALE = 5e-3  # rad, or share of a gripper's opening


class ObservationEncoder(nn.Module):
    """Context tokens (B, L, width), L = To * (V * tokens_per_view + 1) + 1: views and state of each step, one sentence.

    All views of all steps run through the trunk as one batch.
    """

    def __init__(
        self,
        *,
        vision: nn.Module,
        views: int,
        observed_steps: int,
        state_dim: int,
        width: int,
        tokens_per_view: int,
        maps_per_view: int,
        features_per_map: int,
    ) -> None:
        super().__init__()
        self.vision = vision.to(memory_format=torch.channels_last)
        self.view_tokens = ViewTokens(
            views=views,
            channels=vision.channels,
            tokens=tokens_per_view,
            maps=maps_per_view,
            features=features_per_map,
            width=width,
        )
        self.state_normaliser = Normaliser(state_dim)
        self.state = nn.Sequential(nn.Linear(state_dim, width), nn.SiLU(), nn.Linear(width, width))
        self.words = nn.EmbeddingBag(NUM_WORD_IDS, width, mode="mean", padding_idx=0)
        self.step_identity = nn.Parameter(0.02 * torch.randn(observed_steps, 1, width))

    def fit(self, low: Tensor, high: Tensor) -> None:
        """Takes the range of the states (S,), which is stretched to [-1, 1]."""
        self.state_normaliser.fit((low + high) / 2, (high - low) / 2, MIN_STATE_SCALE)

    def forward(self, obs: Observation) -> Tensor:
        batch, steps, views = obs.images.shape[:3]
        pixels = obs.images.flatten(0, 2).contiguous(memory_format=torch.channels_last)
        features = self.vision(pixels.float() / 127.5 - 1)
        seen = self.view_tokens(features.unflatten(0, (batch * steps, views)))
        state = self.state(self.state_normaliser.normalise(obs.state)).flatten(0, 1).unsqueeze(1)
        tokens = torch.cat((seen, state), dim=1).unflatten(0, (batch, steps)) + self.step_identity
        sentence = self.words(obs.instruction).unsqueeze(1)
        return torch.cat((tokens.flatten(1, 2), sentence), dim=1)
