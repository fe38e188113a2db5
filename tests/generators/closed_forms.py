"""Gaussian data N(m, diag s^2), whose marginal and average velocities are known, and what the tests run on it.

Shapes: B batch, H steps, A channels; everything in float64.
"""

import torch
from torch import nn

STEPS, CHANNELS = 3, 2
MEAN = torch.linspace(-0.5, 0.5, STEPS * CHANNELS, dtype=torch.float64).reshape(STEPS, CHANNELS)
STD = torch.linspace(0.3, 1.2, STEPS * CHANNELS, dtype=torch.float64).reshape(STEPS, CHANNELS)


class Context:
    """A conditioning that carries nothing but what the generator asks of one."""

    def repeat(self, times):
        return self

    def rows(self, index):
        return self

    def detach(self, dtype):
        return self


def spread(t):
    return ((1 - t) ** 2 * STD**2 + t**2).sqrt()


def columns(*times):
    return (time[:, None, None] for time in times)


class GaussianFlow(nn.Module):
    """The exact average velocity of Gaussian data, as a core with `velocity` parametrisation."""

    def forward(self, z, t, r, context):
        t, r = columns(t, r)
        gap = t - r
        instant = -MEAN + (t - (1 - t) * STD**2) / spread(t) ** 2 * (z - (1 - t) * MEAN)
        average = -MEAN + (z - (1 - t) * MEAN) * (1 - spread(r) / spread(t)) / torch.where(gap == 0, 1.0, gap)
        return torch.where(gap == 0, instant, average)


class Recorded(nn.Module):
    """A small trainable core, velocity parametrisation, that is smooth in all arguments."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Sequential(
            nn.Linear(STEPS * CHANNELS + 2, 16), nn.Tanh(), nn.Linear(16, STEPS * CHANNELS)
        )
        self.double()

    def forward(self, x, t, r, context):
        y = self.net(torch.cat((x.flatten(1), t[:, None], (t - r)[:, None]), dim=1))
        return y.unflatten(1, (STEPS, CHANNELS))


def draw(count=64):
    rng = torch.Generator().manual_seed(3)
    noise = torch.randn(count, STEPS, CHANNELS, generator=rng, dtype=torch.float64)
    t = 0.1 + 0.9 * torch.rand(count, generator=rng, dtype=torch.float64)
    return noise, t, t * torch.rand(count, generator=rng, dtype=torch.float64)
