"""The frame in which a policy represents action chunks: relative to the arms' current joints, and standardised.

Shapes: B batch, Tp predicted steps, A action, S state; A equals S, channel by channel.
"""

import torch
from torch import Tensor, nn

from imfvla.episode import ACTION_NAMES
from imfvla.errors import UserError
from imfvla.nn.normaliser import Normaliser
from imfvla.statistics import Statistics

FRAMES = RELATIVE, ABSOLUTE = "relative", "absolute"
MIN_SCALE = 2e-3  # rad, or share of a gripper's opening


class ChunkFrame(nn.Module):
    """Chunks (B, Tp, A) in physical units to and from what generators learn, in one of two frames.

    "relative": joint targets minus the joint angles at the decision; each step of the chunk has its own mean and
    deviation. Most of an absolute target is known from the state; what remains is where to go, which only the pictures
    show. Gripper openings stay absolute.
    "absolute": targets as they are, one mean and deviation for all steps.
    """

    def __init__(self, frame: str, steps: int, channels: int) -> None:
        super().__init__()
        if frame not in FRAMES:
            raise UserError(f"action_frame must be relative or absolute, found {frame!r}.")
        joints = [frame == RELATIVE and not name.endswith("gripper") for name in ACTION_NAMES[:channels]]
        self.relative: Tensor
        self.register_buffer("relative", torch.tensor(joints), persistent=False)
        self.normaliser = Normaliser(steps, channels)

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
        return (state * self.relative).unsqueeze(1)
