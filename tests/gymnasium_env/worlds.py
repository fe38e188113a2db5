"""A small Gymnasium environment of the tests, and the config that describes it."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

ID = "imfvla-tests/Slider-v0"


class Slider(gymnasium.Env):
    """Two numbers that the action moves to; the reward is the first. Counts how often it is drawn."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, repeatable: bool = True, render_mode: str | None = None) -> None:
        self.observation_space = spaces.Dict(
            {
                "place": spaces.Box(-5, 5, (2,)),
                "pixels": spaces.Dict({"side": spaces.Box(0, 255, (6, 8, 3), np.uint8)}),
            }
        )
        self.action_space = spaces.Box(np.float32([-2, 0]), np.float32([2, 1]))
        self.render_mode, self._repeatable, self.drawn = render_mode, repeatable, 0

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        draw = self.np_random if self._repeatable else np.random.default_rng()
        self.place, self.steps = draw.uniform(-1, 0, 2), 0
        return self._observation(), {"done": False, "hidden": draw.uniform()}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place, self.steps = np.float64(action), self.steps + 1
        reward = float(self.place[0])
        return self._observation(), reward, reward > 1.9, False, {"done": reward >= 1, "hidden": 0.0}

    def render(self) -> np.ndarray:
        self.drawn += 1
        return np.full((60, 80, 3), 50, np.uint8)

    def _observation(self) -> dict[str, Any]:
        return {"place": self.place.copy(), "pixels": {"side": np.full((6, 8, 3), self.steps, np.uint8)}}


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=Slider)


def config(**changes: Any) -> dict[str, Any]:
    """The config group `task`; `changes` replace its keys, and `robot` those of the robot."""
    robot = {
        "state": ["place/x [m]", "place/y [m]"],
        "action": ["place/x [m]", "place/y [m]"],
        "relative_to": [0, None],
        "action_min": [-2, 0],
        "action_max": [2, 1],
        "control_hz": 20,
        "cameras": [
            {"name": "front", "height": 12, "width": 16},
            {"name": "side", "height": 12, "width": 16},
        ],
    }
    task = {
        "kind": "gymnasium",
        "name": "slider",
        "id": ID,
        "package": None,
        "kwargs": {},
        "state": ["observation/place"],
        "pictures": {"front": "render", "side": "observation/pixels/side"},
        "success": {"of": "info/done", "at_least": 1},
        "stages": {"far": 0.9, "near": 0.5},
        "time_limit_steps": 5,
        "instruction": "slide",
        "sentences": ["go there"],
        "paraphrases": False,
        "expert": None,
        "robot": robot | changes.pop("robot", {}),
    }
    return task | changes


OBSERVATION = {"views": ["front", "side"], "image_size": [12, 16]}
