"""What a rollout needs of a world. dm_control tasks, Gymnasium environments and the tests' fakes implement it."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from imfvla.robot import RobotSpec


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one control step led to."""

    reward: float
    stage: int  # the highest stage that holds now, 0 for none; always 0 where a task has no stages
    success: bool  # whether the episode counts as a success so far
    ended: bool  # whether the world ends the episode here; before its time limit and without success, it is a failure


class Environment(Protocol):
    """A world with one robot. A policy sees it through `state`, `look` and `instruction` alone.

    stages: their names in order, empty where success is a yes or no. instruction and paraphrases: of the episode that
    was reset last. goal: the task of that episode where one scene serves several, else None.

    An environment with a simulator's bodies also has `scene() -> Bodies`; recordings then show them in 3D.
    """

    robot: RobotSpec
    name: str
    instruction: str
    paraphrases: tuple[str, ...]
    goal: str | None
    stages: tuple[str, ...]
    time_limit_steps: int
    views: tuple[str, ...]  # cameras that `look` shows, in this order

    def reset(self, seed: int) -> None:
        """Starts the episode that `seed` determines."""
        ...

    def state(self) -> np.ndarray:
        """The state channels of `robot` now: float32 (S,)."""
        ...

    def look(self) -> dict[str, np.ndarray]:
        """A picture of each of `views`: uint8 (H, W, 3) of its camera's size. Renders only when called."""
        ...

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        """One camera at any size, for videos: uint8 (height, width, 3)."""
        ...

    def step(self, action: np.ndarray) -> Outcome:
        """Applies one action (A,) for one control step."""
        ...

    def start_digest(self) -> str:
        """16 hex digits that name the start state of this episode: equal digits, equal starts."""
        ...

    def renderer(self) -> str:
        """What draws its pictures, such as "llvmpipe (LLVM 15.0.6, 256 bits)"; it decides which rows may be mixed."""
        ...

    def close(self) -> None: ...


class Bodies(Protocol):
    """A simulator's bodies, for the 3D view of recordings: MuJoCo's model and data, or what has the same fields."""

    model: Any
    data: Any


def bodies_of(env: Environment) -> Bodies | None:
    """What an environment shows in 3D now; None where it has no simulator's bodies."""
    scene = getattr(env, "scene", None)
    return None if scene is None else scene()
