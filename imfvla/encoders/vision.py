"""Vision trunks: a batch of pictures to a feature map. No batch statistics, so that EMA weights are valid weights.

Shapes: N pictures (batch x steps x views), C channels, h w feature map.
"""

from torch import Tensor, nn


def norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // 16, channels)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with group norm and a shortcut (arXiv 1512.03385, the basic block)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
            norm(outputs),
            nn.SiLU(),
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False),
            norm(outputs),
        )
        same = stride == 1 and inputs == outputs
        self.shortcut = (
            nn.Identity()
            if same
            else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), norm(outputs))
        )
        self.activation = nn.SiLU()

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.body(x) + self.shortcut(x))


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


class ResNet18(nn.Sequential):
    """ResNet18 with group norm for batch norm, 32 pixels a feature: (N, 3, H, W) -> (N, 512, H / 32, W / 32)."""

    stride = 32

    def __init__(self) -> None:
        super().__init__(
            nn.Conv2d(3, 64, 7, 2, 3, bias=False),
            norm(64),
            nn.SiLU(),
            nn.MaxPool2d(3, 2, 1),
            *(ResidualBlock(64, 64) for _ in range(2)),
            ResidualBlock(64, 128, 2),
            ResidualBlock(128, 128),
            ResidualBlock(128, 256, 2),
            ResidualBlock(256, 256),
            ResidualBlock(256, 512, 2),
            ResidualBlock(512, 512),
        )
        self.channels = 512
