"""Expert of the socket task: both arms pick and lift at once; the right one aligns the peg by feedback."""

from collections.abc import Mapping

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.base import Expert
from imfvla.tasks.experts.hand import lift
from imfvla.tasks.kinematics import rotation_vector
from imfvla.tasks.socket import PEG_LENGTH, SEATED, measure_fit

STANDOFF = -0.045  # depth of the tip where the peg waits for the socket
BEFORE_MOUTH = -0.012  # depth up to which the peg may come while it is not aligned
# a little beyond: the ring ends there, and pressing hard pulls the peg out of the hand
GOAL_DEPTH = SEATED + 0.004
INSERTION_SPEED = 0.05  # m/s
ALIGNED, ALIGNED_ANGLE = 0.0025, 0.04  # m, rad


class SocketExpert(Expert):
    task_name = "socket"
    misses = (("left",), ("right",), ("left", "right"))

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        self.meeting = np.array([0.0, 0.0, 0.18]) + rng.uniform(-1, 1, 3) * [0.015, 0.02, 0.015]
        self.peg_offset = rng.uniform(0.0, 0.02)
        self.tab_offset = rng.uniform(-0.008, 0.008)
        names = ("meeting_x", "meeting_y", "meeting_z")
        return {
            **dict(zip(names, self.meeting.tolist(), strict=True)),
            "peg_offset": self.peg_offset,
            "tab_offset": self.tab_offset,
        }

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        left, right = self.hands["left"], self.hands["right"]
        socket, peg = (self.task.prop_pose(env.physics, name) for name in ("socket", "peg"))
        meeting = Pose(self.meeting, np.eye(3))
        waiting = Pose(self.meeting + np.array([PEG_LENGTH / 2 - STANDOFF, 0, 0]), np.eye(3))

        has_socket = left.closed and self.task.holds(contacts, "left", "socket")
        if has_socket:
            goal = lift(socket, meeting, self.task.props["socket"].rest_height)
            left.move(left.carry(socket, goal), 0.0, self.speed)
        else:
            grasp = self.task.props["socket"].tab_centre + np.array([self.tab_offset, 0, 0])
            self.pick(left, socket, grasp, meeting.position)

        if right.closed and self.task.holds(contacts, "right", "peg"):
            there = np.linalg.norm(socket.position - meeting.position) < 0.02
            if has_socket and there and np.linalg.norm(rotation_vector(socket.rotation)) < 0.12:
                self._insert(socket, peg)
            else:
                goal = lift(peg, waiting, self.task.props["peg"].rest_height)
                right.move(right.carry(peg, goal), 0.0, self.speed)
        else:
            self.pick(right, peg, np.array([self.peg_offset, 0, 0]), waiting.position)

    def _insert(self, socket: Pose, peg: Pose) -> None:
        """Goes deeper only while aligned; otherwise corrects where it is, in front of the mouth or inside."""
        fit = measure_fit(socket, peg)
        aligned = np.abs(fit.aside).max() < ALIGNED and fit.angle < ALIGNED_ANGLE
        depth = GOAL_DEPTH if aligned else max(fit.depth, min(BEFORE_MOUTH, fit.depth + 0.02))
        right = self.hands["right"]
        goal = Pose(socket.at(np.array([PEG_LENGTH / 2 - depth, 0, 0])), socket.rotation)
        near = fit.depth > BEFORE_MOUTH - 0.01
        right.move(right.carry(peg, goal), 0.0, INSERTION_SPEED if near else self.speed)
