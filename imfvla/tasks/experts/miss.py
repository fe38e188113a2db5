"""A grasp that fails on purpose, so that a demonstration shows how one goes on from there."""

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.experts.hand import Hand, lift
from imfvla.tasks.kinematics import about_z

# How far from where an object would be held the fingers close: towards the arm's base, aside [m], above [m] and turned
# [rad]. Trained policies miss by closing too early, and so too high. From here on fingers are above what they are to
# hold, clear of the ring, and more than 2 cm from where `Hand.reach` would go on closing.
SHORT, ASIDE, ABOVE, TURNED = 0.02, 0.01, (0.024, 0.045), 0.3
EMPTY_OPENING = 0.1  # a gripper that is closed around nothing measures less


class Miss:
    """Plays a miss and what a policy does after it: the hand rises as if it held the object, until it notices.

    `over` is whether it has noticed. All is drawn: where the fingers close, and the share of the way to where the
    object would be carried that the hand has covered by then.
    """

    def __init__(self, side: str, rng: np.random.Generator) -> None:
        outward = -1 if side == "left" else 1
        self._offset = np.array(
            [outward * rng.uniform(0, SHORT), rng.uniform(-ASIDE, ASIDE), rng.uniform(*ABOVE)]
        )
        self._turn = about_z(rng.uniform(-TURNED, TURNED))
        self._share = rng.uniform(0, 1)
        self._length: float | None = None  # of the way up, known from the closing on
        self.over = False

    def play(self, hand: Hand, goal: Pose, carried: Pose, height: float, speed: float) -> None:
        """Commands a step: `goal` is where the hand should close, `carried` where it would go then (`Hand.reach`)."""
        wrong = Pose(goal.position + self._offset, self._turn @ goal.rotation)
        left = float(np.linalg.norm(carried.position - hand.pose.position))
        if self._length is None and hand.closed:
            self._length = left
            self.over = hand.opening > EMPTY_OPENING  # something is between the fingers after all
        if self._length is None:
            hand.reach(wrong, height, speed)
        else:
            self.over = self.over or left <= (1 - self._share) * self._length + 0.01
            hand.move(lift(hand.pose, carried, wrong.position[2]), 0.0, speed)
