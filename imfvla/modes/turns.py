"""Which of a gripper's two equivalent yaws samples take, from how far the wrist has rolled within the chunk.

Shapes: N observations, K samples of each, Tp predicted steps, S state, A action.
"""

import numpy as np

from imfvla.robot import RobotSpec, bare_name
from imfvla.tasks.bimanual_robot import DRAWN_WRISTS

STEPS = 16  # the experts roll a wrist by some 0.9 rad in so many control steps, to one side or the other
BRIDGE, ARRIVED = 0.25, 0.75  # rad


def drawn_wrists(modes: int, robot: RobotSpec) -> tuple[int, ...]:
    """Channels, of actions and of the state alike, of the wrists whose way an expert of so many modes draws."""
    names = [bare_name(channel) for channel in robot.action]
    return tuple(names.index(wrist) for wrist in DRAWN_WRISTS[modes])


def turns(chunks: np.ndarray, state: np.ndarray, wrists: tuple[int, ...]) -> np.ndarray:
    """Roll [rad] within STEPS of each wrist in chunks (N, K, Tp, A) that begin in states (N, S): (N, K, wrists)."""
    wrists = list(wrists)
    return chunks[:, :, STEPS - 1, wrists] - state[:, None, wrists]


def measure_turns(found: np.ndarray) -> dict[str, float]:
    """Shares of rolls within BRIDGE of the middle of both ways and beyond ARRIVED, and the mean roll [rad]."""
    size = np.abs(found)
    return {
        "bridge": float((size < BRIDGE).mean()),
        "arrived": float((size > ARRIVED).mean()),
        "amplitude": float(size.mean()),
    }
