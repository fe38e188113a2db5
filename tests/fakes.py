"""Environments and a policy whose every answer is known: rollouts without simulator and training."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from synthetic import StillScene
from torch import Tensor

from imfvla.config.horizon import Horizon
from imfvla.environment import Outcome
from imfvla.robot import Camera, RobotSpec
from imfvla.types import Observation

LIMIT = 4.0  # of every action


def fake_robot(
    num_states: int = 16,
    num_actions: int = 16,
    cameras: tuple[Camera, ...] = (Camera("front", 16, 16), Camera("top", 16, 16)),
    control_hz: float = 50.0,
) -> RobotSpec:
    """A robot of so many channels, the last of each a gripper, the first ones grouped by a slash."""

    def names(count: int) -> tuple[str, ...]:
        return (*(f"arm/joint_{number} [rad]" for number in range(1, count)), "gripper [0, 1]")

    relative = [index if index < num_states - 1 else None for index in range(num_actions - 1)]
    return RobotSpec(
        state=names(num_states),
        action=names(num_actions),
        relative_to=(*relative, None),
        action_min=(-LIMIT,) * num_actions,
        action_max=(LIMIT,) * num_actions,
        control_hz=control_hz,
        cameras=cameras,
    )


ROBOT = fake_robot()


def known_actions(num_steps: int, robot: RobotSpec = ROBOT) -> np.ndarray:
    """float32 (num_steps, A): row s is what the known policies do at step s; no two rows are equal."""
    size = (num_steps, len(robot.action))
    return np.random.default_rng(7).uniform(-1, 1, size).astype(np.float32)


class PlainEnvironment(StillScene):
    """An `Environment` without a simulator's bodies; see `FakeEnvironment`. Without stages, success comes at step 9."""

    variant, instruction, paraphrases, goal = "default", "put the peg into the socket", (), None
    scene = None

    def __init__(
        self,
        time_limit_steps: int = 40,
        ends_at: int | None = None,
        *,
        name: str = "fake",
        robot: RobotSpec = ROBOT,
        stages: tuple[str, ...] = ("reach", "hold", "place"),
    ) -> None:
        super().__init__(robot)
        self.name, self.stages = name, stages
        self.time_limit_steps = time_limit_steps
        self._ends_at = ends_at or time_limit_steps
        self.executed: list[np.ndarray] = []
        self.looked: list[int] = []

    def reset(self, seed: int) -> None:
        self._seed, self._step, self.position = seed, 0, 0.0
        self.executed, self.looked = [], []

    def step(self, action: np.ndarray) -> Outcome:
        self.executed.append(np.array(action))
        self._step += 1
        self.position = float(np.clip(action[0], -1, 1))
        ended = self._step >= self._ends_at
        if not self.stages:
            success = self._seed % 2 == 1 and self._step >= 9
            return Outcome(float(success), 0, success, ended)
        stage = self.stage()
        return Outcome(float(stage), stage, stage == len(self.stages), ended)

    def stage(self) -> int:
        """Rises with the steps, up to a stage that the seed determines."""
        return min(self._step // 8, self._seed % (len(self.stages) + 1))

    def state(self) -> np.ndarray:
        return np.full(len(self.robot.state), self._step, np.float32)

    def start_digest(self) -> str:
        return f"{self._seed:016x}"

    def look(self) -> dict[str, np.ndarray]:
        self.looked.append(self._step)
        frames = super().look()
        for frame in frames.values():
            frame[0, 0, 0], frame[0, 1, 0] = divmod(self._step, 256)
        return frames

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        return np.full((height, width, 3), self._step % 256, np.uint8)

    def renderer(self) -> str:
        return "no renderer"

    def close(self) -> None:
        pass


class FakeEnvironment(PlainEnvironment):
    """Moves where the action says; the first two pixels of each frame and the state tell which step it is."""

    scene = StillScene.scene


@dataclass
class KnownPolicy:
    """Reads the step from the newest frame and predicts `actions` from there on, repeating the last one."""

    horizon: Horizon
    actions: np.ndarray
    noise_scale: float = 0.0
    robot: RobotSpec = ROBOT

    def __post_init__(self) -> None:
        self.views = tuple(camera.name for camera in self.robot.cameras)
        self.image_size = (self.robot.cameras[0].height, self.robot.cameras[0].width)
        self.seen: list[np.ndarray] = []
        self.noises: list[np.ndarray] = []
        self.drawn: list[np.ndarray] = []  # of all candidates
        self.evaluations: list[int] = []

    @property
    def noise_shape(self) -> tuple[int, int]:
        return self.horizon.pred, self.actions.shape[1]

    def eval(self) -> "KnownPolicy":
        return self

    def to(self, device: str) -> "KnownPolicy":
        assert device == "cpu"
        return self

    def check_sampling(self, nfe: int, noise_scale: float, noise: str = "fresh") -> None:
        pass

    def check_replanning(self, nfe: int, candidates: int, prefix: str) -> None:
        pass

    def predict(self, obs: Observation, noise: Tensor, nfe: int) -> Tensor:
        pixels = obs.images[0, :, 0, 0, 0].int().numpy()  # (To, W) of the red channel's first line
        steps = 256 * pixels[:, 0] + pixels[:, 1]
        assert (obs.state[0, :, 0].numpy() == steps).all()
        self.seen.append(steps)
        self.noises.append(noise[0].numpy().copy())
        self.drawn.append(noise.numpy().copy())
        self.evaluations.append(nfe)
        rows, _ = self.horizon.action_steps(int(steps[-1]), len(self.actions))
        return torch.from_numpy(self.actions[rows]).unsqueeze(0) + self.noise_scale * noise


def build_fakes(run: Path, step: int) -> tuple[FakeEnvironment, KnownPolicy]:
    """A `workbench.Build`."""
    del run, step
    return FakeEnvironment(), KnownPolicy(Horizon(1, 8, 4), known_actions(40), noise_scale=0.1)
