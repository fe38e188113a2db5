"""Random numbers of a loss: from a generator, or, in code that is compiled as one graph, from torch's own."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class OwnStream:
    """torch's own random numbers of `device`, as `torch.manual_seed` begins them.

    A graph can hold draws from them, and none from a `torch.Generator`.
    """

    device: torch.device


Stream = torch.Generator | OwnStream


def draw(function: Callable[..., Tensor], *arguments: Any, rng: Stream) -> Tensor:
    """What `function`, which is `torch.rand`, `randn` or `randint`, draws from `rng` on its device."""
    generator = rng if isinstance(rng, torch.Generator) else None
    return function(*arguments, generator=generator, device=rng.device)
