"""Both tasks in one scene: ring, peg and a green bar lie on the table, and the sentence alone says what to do.

Episodes 2 k and 2 k + 1 start from the same state; the first is about the socket, the second about the transfer.
"""

import numpy as np
from dm_control import mjcf

from imfvla.tasks.bimanual import BimanualTask, StartRange
from imfvla.tasks.props import GREEN, Bar, Socket
from imfvla.tasks.socket import APERTURE, PEG_LENGTH, RANGES, insertion_stage
from imfvla.tasks.transfer import BAR_LENGTH, transfer_stage

STAGES = {"socket": insertion_stage, "transfer": transfer_stage}
GOALS = tuple(STAGES)
# peg and bar lie one behind the other, far enough apart for a gripper; which is behind is drawn
LANE_RANGES = {
    "easy": ((0.16, 0.20), (0.09, 0.10), (-0.1, 0.1)),
    "default": ((0.08, 0.26), (0.065, 0.125), (-0.3, 0.3)),
    "hard": ((0.06, 0.28), (0.065, 0.15), (-0.35, 0.35)),
}


class CombinedTask(BimanualTask):
    """The stages of the task of the current episode. Peg and bar swap sides in half of the episodes."""

    name = "combined"

    def __init__(self, variant: str) -> None:
        props = {
            "socket": Socket("socket", APERTURE[variant]),
            "peg": Bar("peg", PEG_LENGTH),
            "bar": Bar("bar", BAR_LENGTH, GREEN),
        }
        super().__init__(variant, props)
        lane = StartRange(*LANE_RANGES[variant])
        self.ranges = {"socket": RANGES[variant][0], "peg": lane, "bar": lane}
        self._goal = GOALS[0]

    @property
    def goal(self) -> str:
        return self._goal

    def begin(self, seed: int) -> np.random.RandomState:
        self._goal = GOALS[seed % 2]
        return np.random.RandomState(seed // 2)

    def draw_starts(self, random_state: np.random.RandomState) -> dict[str, tuple[float, float, float]]:
        starts = super().draw_starts(random_state)
        side = random_state.choice((-1, 1))
        for name, sign in (("peg", side), ("bar", -side)):
            x, y, yaw = starts[name]
            starts[name] = (x, sign * y, yaw)
        return starts

    def stage(self, physics: mjcf.Physics) -> int:
        return STAGES[self.goal](self, physics)
