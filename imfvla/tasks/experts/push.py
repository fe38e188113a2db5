"""Pushes that a hand gets on its way down to a grasp, so that a demonstration shows how it is corrected by sight."""

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.experts.hand import OPEN, Hand
from imfvla.tasks.kinematics import about_z, rotation_vector

# How far trained policies are off when they close, in nine of ten grasps: aside [m] and turned [rad].
ASIDE, TURNED = 0.02, 0.5
HEIGHTS = 0.01, 0.09  # above the grasp [m] where a push begins: outside of where `Hand.reach` closes
NEAR, NEAR_TURN = 0.02, 0.25  # who is pushed is above the grasp, so that pushes do not add up
STEPS = 6  # control steps that a push lasts: three times the arms' lag
SPEED, TURN_SPEED = 0.4, 8.0  # m/s, rad/s


class Pushes:
    """So many pushes of one hand during one approach; when and where to is drawn.

    A push moves the hand aside and turns it, at the height at which it is. What it should do there is what the expert
    does anywhere else; only the push itself is nothing to imitate.
    """

    def __init__(self, count: int, rng: np.random.Generator) -> None:
        heights = np.sort(rng.uniform(*HEIGHTS, count))  # the highest is taken first, from the end
        away, direction = ASIDE * np.sqrt(rng.uniform(size=count)), rng.uniform(-np.pi, np.pi, count)
        offsets = np.stack([away * np.cos(direction), away * np.sin(direction), np.zeros(count)], axis=1)
        self._coming = list(zip(heights, offsets, rng.uniform(-TURNED, TURNED, count), strict=True))
        self._steps_left = 0

    def command(self, hand: Hand, goal: Pose) -> np.ndarray | None:
        """What a hand that should go to `goal` is made to do at this step (8,), None where it is not pushed."""
        if not self._steps_left and self._is_due(hand, goal):
            _, offset, turn = self._coming.pop()
            self._to = Pose(hand.pose.position + offset, about_z(turn) @ hand.pose.rotation)
            self._steps_left = STEPS
        if not self._steps_left:
            return None
        self._steps_left -= 1
        hand.move(self._to, 1.0, SPEED, TURN_SPEED)
        return hand.command

    def _is_due(self, hand: Hand, goal: Pose) -> bool:
        if not self._coming or hand.opening < OPEN:
            return False
        away = hand.pose.position - goal.position
        turn = np.linalg.norm(rotation_vector(goal.rotation @ hand.pose.rotation.T))
        return bool(away[2] < self._coming[-1][0] and np.linalg.norm(away[:2]) < NEAR and turn < NEAR_TURN)
