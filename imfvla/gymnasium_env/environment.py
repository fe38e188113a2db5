"""A Gymnasium environment as an `imfvla.environment.Environment`."""

import hashlib
from typing import Any

import cv2
import numpy as np

from imfvla.environment import Outcome
from imfvla.errors import UserError
from imfvla.gymnasium_env.options import CAMERA, RENDER, REWARD, GymnasiumTask, Threshold
from imfvla.gymnasium_env.packages import Cameras, version_of
from imfvla.gymnasium_env.places import number_leaves, numbers_at, value_at


class GymnasiumEnvironment:
    """Plays a Gymnasium environment; see `conf/task/gymnasium.yaml` for what describes it.

    Pictures are drawn when someone looks, at the size of their camera: by the package's own cameras where they are
    known here, by the environment's `render`, or taken from the last observation. The last two are resized.
    """

    goal = None

    def __init__(self, env: Any, task: GymnasiumTask, cameras: Cameras | None) -> None:
        self.task, self.robot = task, task.robot
        self.name, self.views = task.name, task.views
        self.instruction, self.paraphrases = task.instruction, task.sentences
        self.stages = tuple(task.stages)
        self.time_limit_steps = task.time_limit_steps
        self.gymnasium = env
        self.cameras = cameras
        self._stage_rewards = np.array(list(task.stages.values()))
        self._found: dict[str, Any] = {}

    def reset(self, seed: int) -> None:
        """Starts the episode that `seed` determines."""
        observation, info = self.gymnasium.reset(seed=seed)
        self._found = {"observation": observation, "info": info}
        self._steps, self._success, self._seed = 0, False, seed
        self._start_digest = self._digest_of_start()

    def state(self) -> np.ndarray:
        """float32 (S,). UserError where the environment gives other than S finite numbers."""
        parts = [
            numbers_at(place, self._found, f"task.state[{i}]") for i, place in enumerate(self.task.state)
        ]
        state = np.concatenate(parts)
        wanted = len(self.robot.state)
        if state.shape != (wanted,):
            raise UserError(
                f"task.robot.state names {wanted} channels, but {' and '.join(self.task.state)} of {self.task.id} "
                f"hold {state.size} numbers: name each of them once."
            )
        if not np.isfinite(state).all():
            raise UserError(f"task.state: {self.task.id} gives a state that is not finite: {state}.")
        return state

    def look(self) -> dict[str, np.ndarray]:
        """A picture of each of `views`: uint8 (H, W, 3) of its camera's size."""
        cameras = (self.robot.camera(view) for view in self.views)
        return {camera.name: self.render(camera.name, camera.height, camera.width) for camera in cameras}

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        """One camera at any size: uint8 (height, width, 3)."""
        self.robot.camera(view)
        key, source = f"task.pictures.{view}", self.task.pictures[view]
        kind, _, name = source.partition("/")
        if kind == CAMERA:
            return self._own_camera(name, key).draw(name, height, width)
        picture = self.gymnasium.render() if source == RENDER else value_at(source, self._found, key)
        return _resized(picture, height, width, f"{key}: {source} of {self.task.id}")

    def step(self, action: np.ndarray) -> Outcome:
        """Applies one action (A,). UserError unless it is A finite numbers."""
        action, wanted = np.asarray(action, np.float32), (len(self.robot.action),)
        if action.shape != wanted or not np.isfinite(action).all():
            raise UserError(
                f"Actions of {self.task.id} must be {wanted[0]} finite numbers, found shape {action.shape}: {action}; "
                "check the policy or script that chose it."
            )
        observation, reward, terminated, truncated, info = self.gymnasium.step(action)
        self._found = {"observation": observation, "info": info}
        self._steps += 1
        reward = float(reward)
        self._success = self._success or self._reaches(self.task.success, reward)
        return Outcome(
            reward=reward,
            stage=int((reward >= self._stage_rewards).sum()),
            success=self._success,
            ended=bool(terminated or truncated or self._steps >= self.time_limit_steps),
        )

    def start_digest(self) -> str:
        """16 hex digits of the seed and of all numbers that the start shows, pictures apart."""
        return self._start_digest

    def model_digest(self) -> str:
        """16 hex digits that name the world: environment, arguments, package and version."""
        text = repr((self.task.id, sorted(self.task.kwargs.items()), version_of(self.task.package)))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def renderer(self) -> str:
        """What draws the pictures: an OpenGL driver where that is known, else the package."""
        drawn = any(self.task.pictures[view].startswith(f"{CAMERA}/") for view in self.views)
        return self.cameras.renderer() if self.cameras and drawn else version_of(self.task.package)

    def close(self) -> None:
        if self.cameras is not None:
            self.cameras.close()
        self.gymnasium.close()

    def _reaches(self, threshold: Threshold, reward: float) -> bool:
        if threshold.of == REWARD:
            return reward >= threshold.at_least
        return bool((numbers_at(threshold.of, self._found, "task.success.of") >= threshold.at_least).all())

    def _own_camera(self, name: str, key: str) -> Cameras:
        if self.cameras is None:
            raise UserError(
                f"{key} must be {RENDER} or a place of the observation: no camera of {self.task.id} is known."
            )
        if name not in self.cameras.names:
            raise UserError(
                f"{key} must be one of the cameras {', '.join(self.cameras.names)}, found {name!r}."
            )
        return self.cameras

    def _digest_of_start(self) -> str:
        digest = hashlib.sha256(repr((self.task.id, self._seed)).encode())
        start = {} if self.cameras is None else {"simulator": self.cameras.start()}
        for place, array in number_leaves({**self._found, **start}):
            # Rounded, since the last bits differ between machines.
            numbers = np.round(array.astype(np.float64), 9) + 0.0
            digest.update(place.encode() + numbers.tobytes())
        return digest.hexdigest()[:16]


def _resized(picture: Any, height: int, width: int, where: str) -> np.ndarray:
    """uint8 (height, width, 3). UserError unless it is a colour picture."""
    array = np.asarray(picture)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
        raise UserError(
            f"{where} must be a picture, uint8 (height, width, 3), found {array.dtype} {array.shape}: name another "
            "place."
        )
    if array.shape[:2] == (height, width):
        return array.copy()
    shrinks = height * width < array.shape[0] * array.shape[1]
    return cv2.resize(array, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
