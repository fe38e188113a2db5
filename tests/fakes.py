"""An environment and a policy whose every answer is known: rollouts without simulator and training."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from synthetic import StillScene
from torch import Tensor

from imfvla.episode import ACTION_DIM, STATE_DIM
from imfvla.horizon import Horizon
from imfvla.robot import RobotSpec
from imfvla.tasks.bimanual_robot import bimanual_robot
from imfvla.types import Observation

LIMIT = 4.0  # of every action


VIEWS, IMAGE_SIZE = ("front", "top"), (16, 16)


def fake_robot(views: tuple[str, ...] = VIEWS, image_size: tuple[int, int] = IMAGE_SIZE) -> RobotSpec:
    """The two arms, with wider limits than theirs."""
    limits = (LIMIT,) * ACTION_DIM
    wide = {"action_min": tuple(-limit for limit in limits), "action_max": limits}
    return replace(bimanual_robot(views, image_size), **wide)


def known_actions(num_steps: int) -> np.ndarray:
    """float32 (num_steps, A): row s is what the known policies do at step s; no two rows are equal."""
    return np.random.default_rng(7).uniform(-1, 1, (num_steps, ACTION_DIM)).astype(np.float32)


class FakeEnvironment(StillScene):
    """Moves where the action says; the first two pixels of each frame and the state tell which step it is."""

    name, variant, instruction = "fake", "default", "put the peg into the socket"
    num_stages, success_stage = 3, 3

    def __init__(self, time_limit_steps: int = 40, ends_at: int | None = None) -> None:
        super().__init__(views=VIEWS, image_size=IMAGE_SIZE)
        self.robot = fake_robot()
        context = SimpleNamespace(call=lambda function: "no renderer")
        self.physics.contexts = SimpleNamespace(gl=SimpleNamespace(make_current=lambda: nullcontext(context)))
        self.time_limit_steps = time_limit_steps
        self._ends_at = ends_at or time_limit_steps
        self.executed: list[np.ndarray] = []
        self.looked: list[int] = []

    def reset(self, seed: int) -> SimpleNamespace:
        self._seed, self._step, self.position = seed, 0, 0.0
        self.executed, self.looked = [], []
        return SimpleNamespace(reward=None, last=lambda: False)

    def step(self, action: np.ndarray) -> SimpleNamespace:
        self.executed.append(np.array(action))
        self._step += 1
        self.position = float(np.clip(action[0], -1, 1))
        last = self._step >= self._ends_at
        return SimpleNamespace(reward=float(self.stage()), last=lambda: last)

    def stage(self) -> int:
        """Rises with the steps, up to a stage that the seed determines."""
        return min(self._step // 8, self._seed % (self.num_stages + 1))

    def state(self) -> np.ndarray:
        return np.full(STATE_DIM, self._step, np.float32)

    def start_digest(self) -> str:
        return f"{self._seed:016x}"

    def look(self, views: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
        self.looked.append(self._step)
        frames = super().look(views)
        for frame in frames.values():
            frame[0, 0, 0], frame[0, 1, 0] = divmod(self._step, 256)
        return frames

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        return np.full((height, width, 3), self._step % 256, np.uint8)


@dataclass
class KnownPolicy:
    """Reads the step from the newest frame and predicts `actions` from there on, repeating the last one."""

    horizon: Horizon
    actions: np.ndarray
    noise_scale: float = 0.0
    views, image_size = VIEWS, IMAGE_SIZE

    def __post_init__(self) -> None:
        self.robot = fake_robot()
        self.seen: list[np.ndarray] = []
        self.noises: list[np.ndarray] = []
        self.evaluations: list[int] = []

    @property
    def noise_shape(self) -> tuple[int, int]:
        return self.horizon.pred, ACTION_DIM

    def eval(self) -> "KnownPolicy":
        return self

    def to(self, device: str) -> "KnownPolicy":
        assert device == "cpu"
        return self

    def check_sampling(self, nfe: int, noise_scale: float) -> None:
        pass

    def predict(self, obs: Observation, noise: Tensor, nfe: int) -> Tensor:
        pixels = obs.images[0, :, 0, 0, 0].int().numpy()  # (To, W) of the red channel's first line
        steps = 256 * pixels[:, 0] + pixels[:, 1]
        assert (obs.state[0, :, 0].numpy() == steps).all()
        self.seen.append(steps)
        self.noises.append(noise[0].numpy().copy())
        self.evaluations.append(nfe)
        rows, _ = self.horizon.action_steps(int(steps[-1]), len(self.actions))
        return torch.from_numpy(self.actions[rows]).unsqueeze(0) + self.noise_scale * noise


def build_fakes(run: Path, step: int) -> tuple[FakeEnvironment, KnownPolicy]:
    """A `workbench.Build`."""
    del run, step
    return FakeEnvironment(), KnownPolicy(Horizon(1, 8, 4), known_actions(40), noise_scale=0.1)
