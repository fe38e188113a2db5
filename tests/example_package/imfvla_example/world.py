"""A point on a table that shall reach a mark: an environment without a simulator, and demonstrations of it."""

import hashlib
from collections.abc import Collection
from typing import Annotated

import numpy as np

from imfvla.environment import Outcome
from imfvla.options import at_least
from imfvla.robot import Camera, RobotSpec
from imfvla.sources import EpisodeArrays

SIZE = 32  # px
CAMERA = "top"
SENTENCE = "go to the mark"
NEAR, STRIDE = 0.1, 0.08  # m
STEPS = 40
ROBOT = RobotSpec(
    state=("x [m]", "y [m]"),
    action=("x [m]", "y [m]"),
    relative_to=(0, 1),
    action_min=(-1.0, -1.0),
    action_max=(1.0, 1.0),
    control_hz=10.0,
    cameras=(Camera(CAMERA, SIZE, SIZE),),
)


class PointEnvironment:
    """The point goes where the action says, at most STRIDE a step."""

    robot, instruction, paraphrases, goal = ROBOT, SENTENCE, (), None
    stages, time_limit_steps, views = (), STEPS, (CAMERA,)

    def __init__(self, *, name: str) -> None:
        self.name = name

    def reset(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.position, self.mark = rng.uniform(-0.8, 0.8, (2, 2))
        self._seed, self._step = seed, 0

    def state(self) -> np.ndarray:
        return self.position.astype(np.float32)

    def look(self) -> dict[str, np.ndarray]:
        return {CAMERA: self.render(CAMERA, SIZE, SIZE)}

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        picture = np.zeros((height, width, 3), np.uint8)
        for place, colour in ((self.mark, (0, 255, 0)), (self.position, (255, 0, 0))):
            column, row = ((place + 1) / 2 * (width - 1, height - 1)).astype(int)
            picture[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = colour
        return picture

    def step(self, action: np.ndarray) -> Outcome:
        self.position = self.position + np.clip(action - self.position, -STRIDE, STRIDE)
        self._step += 1
        success = bool(np.abs(self.position - self.mark).max() < NEAR)
        return Outcome(float(success), 0, success, self._step >= STEPS)

    def start_digest(self) -> str:
        return f"{self._seed:016x}"

    def renderer(self) -> str:
        return "numpy"

    def close(self) -> None: ...


class PointEpisodes:
    """Straight ways to the mark from the first `episodes` seeds, computed when they are asked for."""

    robot = ROBOT

    def __init__(self, *, episodes: Annotated[int, at_least(1)]) -> None:
        self.episodes = episodes

    def __len__(self) -> int:
        return self.episodes

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        env = PointEnvironment(name="point")
        env.reset(index)
        states, pictures = [], []
        for _ in range(STEPS):
            states.append(env.state())
            pictures.append(env.look()[CAMERA])
            env.step(env.mark)
        return EpisodeArrays(
            name=f"seed {index}",
            task=env.name,
            instructions=(SENTENCE,),
            state=np.stack(states),
            action=np.tile(env.mark.astype(np.float32), (STEPS, 1)),
            image_steps=np.arange(STEPS),
            images={view: np.stack(pictures) for view in views},
        )

    def num_frames(self, index: int) -> int:
        return STEPS

    def digest(self) -> str:
        return hashlib.sha256(f"{SIZE} {STEPS} {STRIDE} {self.episodes}".encode()).hexdigest()
