"""From feature maps to tokens of each view: the whole map through a matrix, learned spatial attention, or patches.

Shapes: B batch, V views, C channels, h w feature map, P = h w positions, M attention maps, K tokens per view, D width.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class GridTokens(nn.Module):
    """Every feature of a view's map has its weight in every token: (B, V, C, h, w) -> (B, V * tokens, width).

    The place of a feature is its index, so that an object's position is linear in the features and quick to learn. The
    number of weights grows with the map: use it for small maps.
    """

    def __init__(self, *, views: int, channels: int, grid: tuple[int, int], width: int, tokens: int) -> None:
        super().__init__()
        inputs = channels * grid[0] * grid[1]
        self.tokens = tokens
        self.output = nn.Parameter(torch.randn(views, inputs, tokens * width) / math.sqrt(inputs))
        self.identity = nn.Parameter(0.02 * torch.randn(views, tokens, width))

    def forward(self, x: Tensor) -> Tensor:
        tokens = torch.einsum("bvi,vid->bvd", over_last_axis(x.flatten(3)).flatten(2), self.output)
        return (tokens.unflatten(2, (self.tokens, -1)) + self.identity).flatten(1, 2)


class AttendedTokens(nn.Module):
    """Each of `maps` attention maps of a view yields its mean position and the mean of a few features under it.

    A generalised spatial softmax (arXiv 1504.00702): positions make the tokens precise to a fraction of a feature,
    features say what lies there. Every view has weights of its own. (B, V, C, h, w) -> (B, V * tokens, width).

    Features and scores are normalised over the positions of a picture: what stands out is attended to from the
    start. Without it the average of the background outweighs a small object on a table a thousand to one, and a policy
    learns to ignore its cameras.
    """

    def __init__(
        self,
        *,
        views: int,
        channels: int,
        grid: tuple[int, int],
        width: int,
        tokens: int,
        maps: int,
        features: int,
    ) -> None:
        super().__init__()
        if maps % tokens:
            raise ValueError(f"{maps} attention maps cannot be shared evenly by {tokens} tokens per view")
        self.tokens = tokens
        self.maps = nn.Parameter(torch.randn(views, maps, channels) / math.sqrt(channels))
        self.sharpness = nn.Parameter(torch.ones(views, maps, 1))
        self.features = nn.Parameter(torch.randn(views, features, channels) / math.sqrt(channels))
        inputs = (maps // tokens) * (features + 2)
        self.output = nn.Parameter(torch.randn(views, tokens, inputs, width) / math.sqrt(inputs))
        self.identity = nn.Parameter(0.02 * torch.randn(views, tokens, width))

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = over_last_axis(x.flatten(3))
        attention = (self.sharpness * over_last_axis(self.maps @ x)).softmax(-1)  # (B, V, M, P)
        grid = positions(height, width, x)
        seen = torch.cat(((self.features @ x), grid.expand(*x.shape[:2], 2, -1)), dim=2)  # (B, V, F + 2, P)
        pooled = attention @ seen.transpose(-1, -2)  # (B, V, M, F + 2)
        pooled = pooled.unflatten(2, (self.tokens, -1)).flatten(3)
        tokens = torch.einsum("bvki,vkid->bvkd", pooled, self.output) + self.identity
        return tokens.flatten(1, 2)


class PatchTokens(nn.Module):
    """Each square of `factor` x `factor` features as one token: pixel shuffle, then a matrix (arXiv 2504.05299).

    Tokens per view: those squares that cover the map, which is padded with zeros at its lower and right edge.
    (B, V, C, h, w) -> (B, V * tokens, width).
    """

    def __init__(self, *, views: int, channels: int, grid: tuple[int, int], width: int, factor: int) -> None:
        super().__init__()
        self.factor = factor
        self.padding = tuple(-size % factor for size in grid)
        self.tokens = math.prod(math.ceil(size / factor) for size in grid)
        self.connector = nn.Linear(channels * factor**2, width)
        self.identity = nn.Parameter(0.02 * torch.randn(views, self.tokens, width))

    def forward(self, x: Tensor) -> Tensor:
        x = over_last_axis(x.flatten(3)).unflatten(3, x.shape[3:])
        below, right = self.padding
        patches = F.pixel_unshuffle(F.pad(x, (0, right, 0, below)), self.factor)
        return (self.connector(patches.flatten(3).transpose(2, 3)) + self.identity).flatten(1, 2)


def over_last_axis(x: Tensor) -> Tensor:
    """Shifted and scaled to zero mean and unit variance over the last axis."""
    return F.layer_norm(x, x.shape[-1:])


def positions(height: int, width: int, like: Tensor) -> Tensor:
    """Row and column of each feature in [-1, 1], a constant: (2, height * width)."""
    rows = torch.linspace(-1, 1, height, dtype=like.dtype, device=like.device)
    columns = torch.linspace(-1, 1, width, dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij")).flatten(1)
