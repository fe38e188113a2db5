"""gym-aloha's environments without the pictures that they draw in every step.

A step of gym-aloha draws three 480 x 640 cameras with shadows, most of which nobody looks at. Here its physics steps
without them, and a camera is drawn when someone asks, at that size and without shadows.

Start states: gym-aloha draws the objects' poses from a generator of its own that is seeded with the seed of `reset`,
and passes them through a variable of its module. Nothing else is random.
"""

from typing import Any

import cv2
import numpy as np
from dm_control.mujoco import engine

from imfvla.config.views import require_drawable

LARGEST_PICTURE = (960, 1280)  # (H, W) [px]


class AlohaCameras:
    """Cameras of the physics behind an environment of gym-aloha."""

    def __init__(self, physics: Any) -> None:
        self._physics = physics
        model = physics.model
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
        model.vis.global_.offheight, model.vis.global_.offwidth = (2 * size for size in LARGEST_PICTURE)
        self.names = tuple(model.id2name(number, "camera") for number in range(model.ncam))
        self._cameras: dict[tuple[str, int, int], engine.Camera] = {}

    def draw(self, name: str, height: int, width: int) -> np.ndarray:
        """uint8 (height, width, 3), each pixel the mean of 2 x 2: half the time of MuJoCo's own multisampling."""
        require_drawable((height, width), LARGEST_PICTURE)
        key = (name, height, width)
        if key not in self._cameras:
            self._cameras[key] = engine.Camera(self._physics, 2 * height, 2 * width, name)
        return cv2.resize(self._cameras[key].render(), (width, height), interpolation=cv2.INTER_AREA)

    def start(self) -> np.ndarray:
        """Joints and objects, as MuJoCo's qpos."""
        return np.asarray(self._physics.data.qpos).copy()

    def renderer(self) -> str:
        def ask() -> str:
            from OpenGL import GL  # here, since the platform is chosen when mujoco is imported

            return GL.glGetString(GL.GL_RENDERER).decode()

        with self._physics.contexts.gl.make_current() as context:
            return context.call(ask)

    def close(self) -> None:
        self._cameras.clear()
        self._physics.free()


def adapt(env: Any) -> AlohaCameras:
    """Keeps gym-aloha from drawing, gives it the limits of its actuators, and lets it play on after a success.

    gym-aloha says that actions lie in [-1, 1], but they are joint targets in rad. It ends an episode when the reward
    is 4 for the first time; ACT's authors play all 400 steps (arXiv 2304.13705), and so do we.
    """
    from gymnasium import spaces

    world = env.unwrapped
    task, physics = world._env.task, world._env.physics
    task.get_observation = lambda _: {"qpos": task.get_qpos(physics)}
    world._format_raw_obs = lambda raw: {"agent_pos": raw["qpos"]}
    low, high = action_limits(np.asarray(physics.model.actuator_ctrlrange))
    world.action_space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
    plain_step = world.step

    def step(action: np.ndarray) -> tuple[Any, ...]:
        observation, reward, _, truncated, info = plain_step(action)
        return observation, reward, False, truncated, info

    world.step = step
    return AlohaCameras(physics)


def action_limits(ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits (A,) of gym-aloha's actions from those of its actuators (A + 2, 2): two fingers share one opening."""
    joints = [[*ranges[start : start + 6], (0.0, 1.0)] for start in (0, 8)]
    low, high = np.array([limits for arm in joints for limits in arm]).T
    return low, high
