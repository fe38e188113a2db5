"""Targets so far from all others that a squared loss may learn little else: a jump of a joint, a wrong unit, a typo."""

from dataclasses import dataclass

import numpy as np
import torch

from imfvla.data import Windows
from imfvla.policy.chunks import ChunkFrame

FAR = 30.0  # standard deviations; targets of smooth demonstrations lie within 15
_BLOCK = 4096  # windows at once


@dataclass(frozen=True, slots=True)
class FarTargets:
    """Those of the training items whose targets lie beyond FAR, and the farthest one."""

    items: int
    deviations: float
    channel: str
    item: str  # its episode and step

    def __str__(self) -> str:
        return (
            f"Targets of {self.items} training items lie more than {FAR:.0f} standard deviations from the mean, up to "
            f"{self.deviations:.0f} ({self.channel}, {self.item}). Squared errors may learn little else: look at these "
            "episodes, and leave them out if they are mistakes."
        )


def far_targets(windows: Windows, chunks: ChunkFrame) -> FarTargets | None:
    """What `chunks`, fitted to these windows, gives beyond FAR; None where there is nothing."""
    items, deviations, window, channel = 0, FAR, 0, 0
    for first in range(0, len(windows), _BLOCK):
        indices = np.arange(first, min(first + _BLOCK, len(windows)))
        state, actions, valid = map(torch.from_numpy, windows.decided(indices))
        size = (chunks.normalise(actions, state).abs() * valid[..., None]).amax(dim=1)  # (B, A)
        items += int((size > FAR).any(dim=1).sum())
        farthest = int(size.argmax())
        if float(size.flatten()[farthest]) > deviations:
            deviations = float(size.flatten()[farthest])
            window, channel = first + farthest // size.shape[1], farthest % size.shape[1]
    if not items:
        return None
    name = windows.robot.action[channel]
    return FarTargets(items, deviations, name, windows.describe(np.array([window]))[0])
