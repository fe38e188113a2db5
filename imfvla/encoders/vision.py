"""Vision trunks: a batch of pictures to a feature map. No batch statistics, so that EMA weights are valid weights.

A stage is a run of residual blocks at one resolution. Its residual is "standard", each block's sum with its input, or
"attention", depth-wise attention over the stage's input and the increments of its blocks so far.

Shapes: N pictures (batch x steps x views), C channels, h w feature map.
"""

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from imfvla.encoders.imagenet import DEVIATION, MEAN, load_torchvision
from imfvla.errors import UserError

Residual = Literal["standard", "attention"]


def in_unit_range(pixels: Tensor) -> Tensor:
    """uint8 pixels as floats in [-1, 1], in one new array."""
    return pixels.float().div_(127.5).sub_(1)


def norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // 16, channels)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with group norm and a shortcut (arXiv 1512.03385, the basic block)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.channels = outputs
        self.body = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
            norm(outputs),
            nn.ReLU(),
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False),
            norm(outputs),
        )
        same = stride == 1 and inputs == outputs
        self.shortcut = (
            nn.Identity()
            if same
            else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), norm(outputs))
        )
        self.activation = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.body(x) + self.shortcut(x))


class AttentionStage(nn.Sequential):
    """Residual blocks whose sums are replaced by Attention Residuals (paper eq. 12-14), at each position by itself.

    Increments of different resolutions cannot be mixed, so that every stage has a history of its own: it begins with
    the stage's input, brought to the stage's size by the first block's shortcut, and the attention behind the last
    block is what the next stage sees. Block l adds its body's output y_l; the activation of sum_s a_{l,s} y_s, s = 0
    ... l, is what follows. Queries start at zero: the mean of the history.
    """

    def __init__(self, *blocks: ResidualBlock) -> None:
        super().__init__(*blocks)
        self.query = nn.Parameter(torch.zeros(len(blocks), blocks[-1].channels))

    def forward(self, x: Tensor) -> Tensor:
        increments = [self[0].shortcut(x)]
        for block, query in zip(self, self.query, strict=True):
            increments.append(block.body(x))
            x = block.activation(attend_over_depth(increments, query))
        return x


def attend_over_depth(increments: list[Tensor], query: Tensor) -> Tensor:
    """sum_s a_s y_s, a_s = softmax_s(w . RMSNorm(y_s)) at each position, of maps (N, C, h, w) and a query (C,)."""
    scores = [F.rms_norm(y.movedim(1, -1), query.shape, query, eps=1e-6).sum(-1) for y in increments]
    weights = torch.stack(scores).softmax(0).unsqueeze(2)
    return sum(weight * y for weight, y in zip(weights, increments, strict=True))


def make_stage(residual: Residual, *blocks: ResidualBlock) -> nn.Sequential:
    """The blocks as a stage; parameters of the blocks have the same names with either residual."""
    stages = {"standard": nn.Sequential, "attention": AttentionStage}
    if residual not in stages:
        raise UserError(f"encoder.vision.residual must be standard or attention, found {residual!r}.")
    return stages[residual](*blocks)


class CompactCNN(nn.Sequential):
    """Three strided convolutions for CPUs, 16 pixels a feature: (N, 3, H, W) -> (N, channels, H / 16, W / 16)."""

    stride = 16

    def __init__(self, hidden: tuple[int, int], channels: int) -> None:
        super().__init__(
            nn.Conv2d(3, hidden[0], 5, 4, 2),
            nn.SiLU(),
            nn.Conv2d(hidden[0], hidden[1], 3, 2, 1),
            nn.SiLU(),
            nn.Conv2d(hidden[1], channels, 3, 2, 1),
            nn.SiLU(),
        )
        self.channels = channels


class CompactResNet(nn.Module):
    """The compact trunk with residual blocks at its last resolution: (N, 3, H, W) -> (N, channels, H / 16, W / 16)."""

    stride = 16

    def __init__(self, hidden: tuple[int, int], channels: int, num_blocks: int, residual: Residual) -> None:
        super().__init__()
        width = hidden[1]
        self.stem = nn.Sequential(
            nn.Conv2d(3, hidden[0], 5, 4, 2),
            nn.SiLU(),
            nn.Conv2d(hidden[0], width, 3, 2, 1),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, 2, 1, bias=False),
            norm(width),
            nn.ReLU(),
        )
        self.stage = make_stage(residual, *(ResidualBlock(width, width) for _ in range(num_blocks)))
        self.output = nn.Sequential(nn.Conv2d(width, channels, 1), nn.SiLU())
        self.channels = channels

    def forward(self, x: Tensor) -> Tensor:
        return self.output(self.stage(self.stem(x)))


class ResNet18(nn.Module):
    """ResNet18 with group norm for batch norm, 32 pixels a feature: (N, 3, H, W) -> (N, 512, H / 32, W / 32).

    `pretrained` is torchvision's resnet18 as a safetensors file, or None. Pictures are standardised as for ImageNet.
    """

    stride = 32
    channels = 512

    def __init__(self, residual: Residual = "standard", pretrained: str | None = None) -> None:
        super().__init__()
        self.pretrained = pretrained
        self.mean: Tensor
        self.deviation: Tensor
        pixels = torch.tensor((MEAN, DEVIATION)).view(2, 3, 1, 1)  # in [0, 1], those of x in [-1, 1]
        self.register_buffer("mean", 2 * pixels[0] - 1, persistent=False)
        self.register_buffer("deviation", 2 * pixels[1], persistent=False)
        self.stem = nn.Sequential(
            nn.Conv2d(3, 64, 7, 2, 3, bias=False), norm(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        )
        widths = (64, 64, 128, 256, 512)
        self.stages = nn.Sequential(
            *(
                make_stage(
                    residual,
                    ResidualBlock(inputs, outputs, 1 if inputs == outputs else 2),
                    ResidualBlock(outputs, outputs),
                )
                for inputs, outputs in pairwise(widths)
            )
        )

    def initialise_from_pretrained(self) -> None:
        """Loads ImageNet's weights if `pretrained` names a file. Raises UserError where the file does not fit."""
        if self.pretrained is not None:
            load_torchvision(self, self.pretrained)

    def forward(self, x: Tensor) -> Tensor:
        return self.stages(self.stem((x - self.mean) / self.deviation))
