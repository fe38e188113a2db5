"""Tensors passed between data, policy and loop.

Shapes: B batch, To observed steps, V views, H W pixels, S state, L instruction words, Tp predicted steps, A action.
"""

import re
import zlib
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

MAX_WORDS = 16
NUM_WORD_IDS = 512  # id 0 is padding; 1 ... NUM_WORD_IDS - 1 are words


@dataclass(frozen=True, slots=True)
class Observation:
    """What a policy sees at one decision."""

    images: Tensor  # uint8   (B, To, V, 3, H, W)
    state: Tensor  # float32 (B, To, S)  in the units that the robot's channels state
    instruction: Tensor  # int64   (B, L)  word ids, 0 is padding

    def to(self, device: torch.device | str) -> "Observation":
        return Observation(
            *(getattr(self, field.name).to(device, non_blocking=True) for field in fields(self))
        )


@dataclass(frozen=True, slots=True)
class Batch:
    """Observations with the actions that followed."""

    obs: Observation
    actions: Tensor  # float32 (B, Tp, A)  physical units; actions[:, 0] is applied right after the last observation
    valid: Tensor  # bool    (B, Tp)  False past the episode's end

    def to(self, device: torch.device | str) -> "Batch":
        return Batch(self.obs.to(device), self.actions.to(device), self.valid.to(device))


def tokenize(text: str) -> np.ndarray:
    """Word ids of a sentence: int64 (MAX_WORDS,), case and punctuation ignored, cut or padded with 0 to MAX_WORDS.

    By hashing: any sentence works, no vocabulary file, the same ids everywhere.
    """
    words = re.findall(r"[a-z0-9]+", text.lower())[:MAX_WORDS]
    ids = np.zeros(MAX_WORDS, dtype=np.int64)
    ids[: len(words)] = [1 + zlib.crc32(word.encode()) % (NUM_WORD_IDS - 1) for word in words]
    return ids
