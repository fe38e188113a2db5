"""Where episodes to learn from come from: recordings, data sets of other projects, a scripted expert.

Shapes: T control steps, K steps with frames, S state, A action, H W pixels.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imfvla.robot import RobotSpec


@dataclass(frozen=True, slots=True)
class EpisodeArrays:
    """One episode as a policy learns from it."""

    name: str  # unique within its source, and how messages name the episode: a file, a number
    task: str
    instructions: tuple[str, ...]  # the recorded sentence, then its paraphrases
    state: np.ndarray  # float32 (T, S)  before the action, finite
    action: np.ndarray  # float32 (T, A)  what a policy should learn, finite
    image_steps: np.ndarray  # int64 (K,)  ascending steps at which every view has a frame
    images: Mapping[
        str, np.ndarray
    ]  # view -> uint8 (K, H, W, 3), at the size of its camera; empty if not asked for
    imitate: np.ndarray | None = (
        None  # bool (T,)  whether to learn what is done at a step; None: at every step
    )


class EpisodeSource(Protocol):
    """Episodes of one robot in a fixed order."""

    robot: RobotSpec

    def __len__(self) -> int: ...

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        """Episode `index` with the pictures of these views. May be called from several threads.

        Raises UserError naming file, key, what was wanted and found, where it is damaged or does not fit `robot`.
        """
        ...

    def num_frames(self, index: int) -> int:
        """Steps of episode `index` that have frames, without decoding them."""
        ...

    def digest(self) -> str:
        """Hex digits that change with anything that `episode` would answer; reads as little as that takes."""
        ...
