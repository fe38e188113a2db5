"""Conditions of cameras, sensors and commands, for any environment; and objects that are seen alone."""

import math
from collections import deque

import cv2
import numpy as np

from imfvla.conditions.change import Change, Pictures, either_way
from imfvla.environment import Environment
from imfvla.robot import RobotSpec, bare_name


class Light(Change):
    """All cameras see the scene brighter or darker, and tinted: one factor for each colour, the whole episode.

    Of a scene without shine and shadows this is what brighter, weaker or coloured lamps do.
    """

    LEVELS = ((1.15, 0.05), (1.3, 0.1), (1.6, 0.2))  # brightness, upwards or downwards; share of each colour

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        brightness, tint = self.level
        self._gains = (either_way(brightness, rng) * (1 + rng.uniform(-tint, tint, 3))).astype(np.float32)

    def pictures(self, pictures: Pictures, rng: np.random.Generator) -> Pictures:
        return {view: _as_picture(self._gains * picture) for view, picture in pictures.items()}


class PixelNoise(Change):
    """Every number of every picture is off by a normal error, drawn in each step."""

    LEVELS = (8, 20, 40)  # deviation, of 255

    def pictures(self, pictures: Pictures, rng: np.random.Generator) -> Pictures:
        return {
            view: _as_picture(picture + self.level * rng.standard_normal(picture.shape, dtype=np.float32))
            for view, picture in pictures.items()
        }


class Blur(Change):
    """All cameras are out of focus: a Gaussian blur of a share of the picture's height."""

    LEVELS = (0.008, 0.015, 0.03)

    def pictures(self, pictures: Pictures, rng: np.random.Generator) -> Pictures:
        return {
            view: cv2.GaussianBlur(
                picture, (0, 0), self.level * picture.shape[0], borderType=cv2.BORDER_REFLECT
            )
            for view, picture in pictures.items()
        }


class DroppedFrames(Change):
    """All cameras stall together, again and again: while they do, they show the moment at which they stalled.

    A stall lasts `level` seconds; the time to the next one is drawn, with the same mean.
    """

    LEVELS = (0.1, 0.2, 0.4)

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        self._rng = rng
        self._length = max(1, round(self.level * env.robot.control_hz))
        self._kept: Pictures | None = None
        self._next = self._gap()
        self._end = 0

    def after_step(self, env: Environment, step: int) -> None:
        if step == self._next:
            self._kept = env.look()
            self._end = step + self._length
            self._next = self._end + self._gap()
        elif step >= self._end:
            self._kept = None

    def pictures(self, pictures: Pictures, rng: np.random.Generator) -> Pictures:
        return pictures if self._kept is None else dict(self._kept)

    def _gap(self) -> int:
        return int(self._rng.integers(1, 2 * self._length, endpoint=True))


class JointBias(Change):
    """Position sensors are off by a constant each, the whole episode: a share of the range of what they measure."""

    LEVELS = (0.005, 0.01, 0.02)

    def lacking(self, env: Environment) -> str | None:
        return None if _ranges(env.robot).any() else "state channels that an action moves"

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        ranges = _ranges(env.robot)
        share = rng.uniform(0.5, 1, len(ranges)) * rng.choice((-1, 1), len(ranges))
        self._bias = (self.level * share * ranges).astype(np.float32)

    def state(self, state: np.ndarray) -> np.ndarray:
        return state + self._bias


class ActionLag(Change):
    """Every action is applied some steps late; until then the first one of the episode is."""

    LEVELS = (0.04, 0.08, 0.16)  # s

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        self._steps = math.ceil(self.level * env.robot.control_hz - 1e-9)
        self._queue: deque[np.ndarray] = deque()

    def action(self, action: np.ndarray) -> np.ndarray:
        if not self._queue:
            self._queue.extend([action] * self._steps)
        self._queue.append(action)
        return self._queue.popleft()


class Distractors(Change):
    """Objects that the task does not need lie on the table. They are seen, and nothing can touch them."""

    LEVELS = (2, 4, 7)

    def lacking(self, env: Environment) -> str | None:
        return None if hasattr(env, "distract") else "a table to put objects on (`distract`)"

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        env.distract(self.level, rng)


def _as_picture(values: np.ndarray) -> np.ndarray:
    """uint8, rounded, within the range."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _ranges(robot: RobotSpec) -> np.ndarray:
    """Of each state channel (S,) the range of the action that aims at it; 0 where there is none."""
    names = [bare_name(channel) for channel in robot.state]
    ranges = np.zeros(len(names))
    for channel, origin, low, high in zip(
        robot.action, robot.relative_to, robot.action_min, robot.action_max, strict=True
    ):
        if origin is None and bare_name(channel) in names:
            origin = names.index(bare_name(channel))
        if origin is not None:
            ranges[origin] = high - low
    return ranges
