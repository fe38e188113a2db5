"""gym-pusht's environment, drawn when someone looks.

Its `render` marks the last action in the picture, and its observations show none; a policy sees the latter.
"""

from typing import Any

import numpy as np


class PushTCameras:
    """The view from above."""

    names = ("top",)

    def __init__(self, world: Any) -> None:
        self._world = world

    def draw(self, name: str, height: int, width: int) -> np.ndarray:
        """uint8 (height, width, 3), without a mark of the last action."""
        world = self._world
        return world._get_img(world._draw(), width=width, height=height)

    def start(self) -> np.ndarray:
        """Positions of agent and block [px], and the block's angle [rad]."""
        world = self._world
        return np.array([*world.agent.position, *world.block.position, world.block.angle])

    def renderer(self) -> str:
        return "pygame"

    def close(self) -> None:
        """pygame's surfaces need none."""


def adapt(env: Any) -> PushTCameras:
    """The environment's picture; with obs_type=environment_state_agent_pos it draws none by itself."""
    return PushTCameras(env.unwrapped)
