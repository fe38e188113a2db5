"""Either arm: both arms lift a bar between them, each at its own end; then one lets go and the other keeps it."""

import numpy as np
from dm_control import mjcf

from imfvla.tasks.bimanual import SIDES, BimanualTask, StartRange
from imfvla.tasks.props import Bar

BAR_LENGTH = 0.22
RANGES = {
    "easy": StartRange((-0.01, 0.01), (-0.02, 0.02), (-0.1, 0.1)),
    "default": StartRange((-0.03, 0.03), (-0.10, 0.10), (-0.4, 0.4)),
    "hard": StartRange((-0.04, 0.04), (-0.125, 0.125), (-0.55, 0.55)),
}
LIFTED = 0.03  # above the resting height
WITHDRAWN = 0.04  # from the bar's axis to the point between the fingertips of a hand that has left it


class EitherArmTask(BimanualTask):
    """Stages: 1 one gripper holds the bar, 2 both do, 3 lifted by both, 4 one alone, in the air, 5 the other is away.

    The last two count only after both have lifted the bar: an arm that lifts it alone does not solve the task.
    """

    name = "either_arm"

    def __init__(self, variant: str) -> None:
        super().__init__(variant, {"bar": Bar("bar", BAR_LENGTH)})
        self.ranges = {"bar": RANGES[variant]}
        self.shared = False  # whether both have held the bar in the air in this episode

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.shared = False
        super().initialize_episode(physics, random_state)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.shared = self.shared or self.stage(physics) == 3

    def stage(self, physics: mjcf.Physics) -> int:
        contacts = self.contacts(physics)
        holding = [side for side in SIDES if self.holds(contacts, side, "bar")]
        height = self.prop_pose(physics, "bar").position[2] - self.props["bar"].rest_height
        lifted = height > LIFTED and not self.on_table(contacts, "bar")
        if len(holding) != 1:
            return (3 if lifted else 2) if holding else 0
        (other,) = set(SIDES) - set(holding)
        if not (lifted and self.shared) or self.touches(contacts, other, "bar"):
            return 1
        return 5 if self.distance(physics, other) > WITHDRAWN else 4

    def distance(self, physics: mjcf.Physics, side: str) -> float:
        """From the point between the fingertips of one arm to the bar's axis [m]."""
        bar, grip = self.prop_pose(physics, "bar"), self.grip_pose(physics, side)
        offset = bar.rotation.T @ (grip.position - bar.position)
        offset[0] -= np.clip(offset[0], -BAR_LENGTH / 2, BAR_LENGTH / 2)
        return float(np.linalg.norm(offset))
