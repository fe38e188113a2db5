"""Expert of the transfer task: the right arm brings the bar to the meeting point, the left one takes it there."""

from collections.abc import Mapping

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.base import Expert
from imfvla.tasks.experts.hand import OPEN, lift
from imfvla.tasks.kinematics import about_z, rotation_vector

ABOVE = 0.07  # where the left hand waits above the bar
TAKE_SPEED = 0.12  # m/s
RETREAT = np.array([0.03, 0, 0.07])  # of the right hand from where it gave the bar


class TransferExpert(Expert):
    task_name = "transfer"
    dwells = True

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        self._in_place = 0  # control steps that the open left hand has been around the bar
        self.meeting = np.array([0.0, 0.0, 0.16]) + rng.uniform(-1, 1, 3) * [0.015, 0.02, 0.015]
        self.give_at = rng.uniform(0.05, 0.07)  # along the bar, from its middle to the right
        self.take_at = rng.uniform(-0.07, -0.05)
        # Drawn last, so that the rest of the style does not change with it.
        self.wait = int(rng.geometric(1 / self.dwell)) if self.dwell else 0
        names = ("meeting_x", "meeting_y", "meeting_z")
        style = {
            **dict(zip(names, self.meeting.tolist(), strict=True)),
            "give_at": self.give_at,
            "take_at": self.take_at,
        }
        return style | {"wait": self.wait} if self.dwell else style

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        left, right = self.hands["left"], self.hands["right"]
        bar = self.task.prop_pose(env.physics, "bar")
        # half a turn changes nothing about a symmetric bar
        if abs(rotation_vector(bar.rotation)[2]) > np.pi / 2:
            bar = Pose(bar.position, bar.rotation @ about_z(np.pi))
        meeting = Pose(self.meeting, np.eye(3))
        rest_height = self.task.props["bar"].rest_height
        raised = bar.position[2] > rest_height + 0.05
        left_has, right_has = (
            hand.closed and self.task.holds(contacts, hand.side, "bar") for hand in (left, right)
        )
        offered = (
            raised
            and np.linalg.norm(bar.position - meeting.position) < 0.015
            and np.linalg.norm(rotation_vector(bar.rotation)) < 0.1
        )
        take = Pose(
            bar.at(np.array([self.take_at, 0, 0])), bar.rotation @ about_z(self.turn["left"] * np.pi / 2)
        )

        if right_has and not left_has:
            goal = lift(bar, meeting, rest_height)
            right.move(right.carry(bar, goal), 0.0, self.speed)
        elif left_has and raised:
            free = right.opening > OPEN
            gave = self.meeting + np.array([self.give_at, 0, 0])
            rest = Pose(gave + RETREAT, about_z(self.turn["right"] * np.pi / 2))
            right.move(rest if free else right.pose, 1.0, self.speed)
        else:
            self.pick(right, bar, np.array([self.give_at, 0, 0]), self.meeting)

        if left_has and raised:
            left.move(left.carry(bar, meeting), 0.0, self.speed)
        elif offered and right_has:
            aside = np.linalg.norm((take.position - left.pose.position)[:2])
            turn = np.linalg.norm(rotation_vector(take.rotation @ left.pose.rotation.T))
            away = np.clip(max(aside / 0.02, turn / 0.25) - 0.3, 0, 1)
            goal = Pose(take.position + np.array([0, 0, ABOVE * away]), take.rotation)
            ready = left.is_at(take, 0.008, 0.08) or (left.opening < OPEN and left.is_at(take, 0.02, 0.3))
            self._in_place += ready
            left.move(goal, 0.0 if ready and self._in_place > self.wait else 1.0, TAKE_SPEED)
        else:
            rotation = about_z(self.turn["left"] * np.pi / 2)
            left.move(Pose(self.meeting + np.array([self.take_at, 0, ABOVE]), rotation), 1.0, self.speed)
