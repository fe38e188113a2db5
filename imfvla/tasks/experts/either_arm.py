"""Expert of the either-arm task: both arms do the same until they hold the bar still in the air; then one lets go."""

from collections.abc import Mapping

import numpy as np

from imfvla.tasks.bimanual import SIDES, Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.base import Expert
from imfvla.tasks.experts.hand import OPEN, lift
from imfvla.tasks.kinematics import about_z, rotation_vector

GRASPS = {"left": (-0.075, -0.055), "right": (0.055, 0.075)}  # along the bar, from its middle
RETREAT = {"left": np.array([-0.03, 0, 0.07]), "right": np.array([0.03, 0, 0.07])}
IN_PLACE, IN_PLACE_ANGLE = 0.012, 0.08  # m, rad


class EitherArmExpert(Expert):
    task_name = "either_arm"
    misses = (("left",), ("right",), ("left", "right"))
    dwells = True

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        self._in_place = 0  # control steps that both have held the bar where it is handed over
        self.meeting = np.array([0.0, 0.0, 0.16]) + rng.uniform(-1, 1, 3) * [0.01, 0.02, 0.015]
        self.grasps = {side: rng.uniform(*GRASPS[side]) for side in SIDES}
        # Nothing in the observation shows who lets go before it does, nor when.
        self.giver = str(rng.choice(SIDES))
        self.wait = int(rng.geometric(1 / self.dwell)) if self.dwell else 0
        names = ("meeting_x", "meeting_y", "meeting_z")
        return {
            **dict(zip(names, self.meeting.tolist(), strict=True)),
            **{f"grasp_{side}": self.grasps[side] for side in SIDES},
            "giver": self.giver,
            "wait": self.wait,
        }

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        bar = self.task.prop_pose(env.physics, "bar")
        # half a turn changes nothing about a symmetric bar
        if abs(rotation_vector(bar.rotation)[2]) > np.pi / 2:
            bar = Pose(bar.position, bar.rotation @ about_z(np.pi))
        meeting = Pose(self.meeting, np.eye(3))
        rest_height = self.task.props["bar"].rest_height
        raised = bar.position[2] > rest_height + 0.01
        both = all(
            hand.closed and self.task.holds(contacts, side, "bar") for side, hand in self.hands.items()
        )
        if not (both or raised):
            for side, hand in self.hands.items():
                self.pick(hand, bar, np.array([self.grasps[side], 0, 0]), self.meeting)
            return
        self._in_place += bool(
            both
            and np.linalg.norm(bar.position - meeting.position) < IN_PLACE
            and np.linalg.norm(rotation_vector(bar.rotation)) < IN_PLACE_ANGLE
        )
        for side, hand in self.hands.items():
            if side == self.giver and self._in_place > self.wait:
                gave = meeting.position + np.array([self.grasps[side], 0, 0]) + RETREAT[side]
                rest = Pose(gave, about_z(self.turn[side] * np.pi / 2))
                hand.move(rest if hand.opening > OPEN else hand.pose, 1.0, self.speed)
            else:
                goal = meeting if self._in_place > self.wait else lift(bar, meeting, rest_height)
                hand.move(hand.carry(bar, goal), 0.0, self.speed)
