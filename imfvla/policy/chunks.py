"""The frame in which a policy represents action chunks: relative to the robot's present state, and standardised.

Shapes: B batch, Tp predicted steps, A action, S state.
"""

import torch
from torch import Tensor, nn

from imfvla.data.statistics import Statistics
from imfvla.errors import UserError
from imfvla.nn.normaliser import Normaliser
from imfvla.robot import FRAMES, RELATIVE, RobotSpec

MIN_SCALE = 2e-3  # in the unit of the channel: rad, m, a share of an opening


class ChunkFrame(nn.Module):
    """Chunks (B, Tp, A) in physical units to and from what generators learn, in one of two frames.

    "relative": targets minus the state at the decision, channel by channel as `robot.relative_to` says; each step of
    the chunk has its own mean and deviation. Most of an absolute target is known from the state; what remains is where
    to go, which only the pictures show. Channels that are relative to none, as grippers are, stay absolute.
    "absolute": targets as they are, one mean and deviation for all steps.
    """

    def __init__(self, frame: str, steps: int, robot: RobotSpec) -> None:
        super().__init__()
        if frame not in FRAMES:
            raise UserError(f"action_frame must be relative or absolute, found {frame!r}.")
        self.relative: Tensor
        self.origin: Tensor
        relative = torch.from_numpy(robot.relative) & (frame == RELATIVE)
        self.register_buffer("relative", relative, persistent=False)
        self.register_buffer("origin", torch.from_numpy(robot.origin), persistent=False)
        self.normaliser = Normaliser(steps, len(robot.action))

    def fit(self, statistics: Statistics) -> None:
        """Takes means and deviations from `statistics`."""
        moments = (
            torch.where(self.relative, torch.as_tensor(displaced), torch.as_tensor(absolute))
            for displaced, absolute in (
                (statistics.displacement_mean, statistics.action_mean),
                (statistics.displacement_std, statistics.action_std),
            )
        )
        self.normaliser.fit(*moments, MIN_SCALE)

    def normalise(self, actions: Tensor, state: Tensor) -> Tensor:
        """Chunks (B, Tp, A) in physical units, decided at the states (B, S) -> normalised."""
        return self.normaliser.normalise(actions - self._origin(state))

    def denormalise(self, chunk: Tensor, state: Tensor) -> Tensor:
        """Inverse of `normalise`."""
        return self.normaliser.denormalise(chunk) + self._origin(state)

    def _origin(self, state: Tensor) -> Tensor:
        """What chunks decided at the states (B, S) are displacements of: (B, 1, A)."""
        return (state[:, self.origin] * self.relative).unsqueeze(1)
