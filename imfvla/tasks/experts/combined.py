"""Expert of the combined scene: that of the task which the episode is about."""

from typing import Any

import numpy as np

from imfvla.episode import Decision
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.socket import SocketExpert
from imfvla.tasks.experts.transfer import TransferExpert


class CombinedExpert:
    """An `episode.Actor` with the arguments of `Expert`."""

    def __init__(self, *, dwell: int, **shared: Any) -> None:
        self._experts = {
            "socket": SocketExpert(**shared, dwell=0),
            "transfer": TransferExpert(**shared, dwell=dwell),
        }
        self._expert = self._experts["socket"]

    @property
    def style(self) -> dict[str, Any]:
        return self._expert.style

    def reset(self, env: BimanualEnvironment, seed: int) -> None:
        self._expert = self._experts[env.task.goal]
        self._expert.reset(env, seed)

    def act(self, env: BimanualEnvironment, state: np.ndarray, step: int) -> Decision:
        return self._expert.act(env, state, step)

    def done(self, env: BimanualEnvironment) -> bool:
        return self._expert.done(env)
