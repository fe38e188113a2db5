"""One controlled hand of an expert.

A hand is pulled towards a goal by a carrot: the commanded pose lies ahead of the measured one by at most the distance
that is covered within the arm's lag. Drift and noise are thereby corrected in the recorded actions.
"""

import numpy as np

from imfvla.tasks.bimanual import BimanualTask, Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.kinematics import ArmKinematics, rotation_matrix, rotation_vector
from imfvla.tasks.robot import home_joints

CARROT_S = 0.065  # the arms' lag and half a control step: how far ahead of the hand its command lies
TURN_SPEED = 2.0  # rad/s
HELD_OPENING = 0.33  # a gripper around a bar measures 0.27
OPEN = 0.6  # from here on a gripper is wide enough to go around a bar
# full noise this far [m] from the goal, this share of it at the goal
FREE_DISTANCE, LEAST_FREEDOM = 0.08, 0.2
ARM = {"left": slice(0, 7), "right": slice(8, 15)}  # channels of state and action
GRIPPER = {"left": 7, "right": 15}


class Hand:
    """One arm's command: moves the grip frame towards goals and opens or closes the gripper."""

    def __init__(self, task: BimanualTask, side: str, kinematics: ArmKinematics) -> None:
        self.side = side
        self._task, self._kinematics = task, kinematics
        self.home = kinematics.pose(home_joints())
        self.pose: Pose = None  # measured
        self.joints: np.ndarray = None  # measured (7,)
        self.opening = 1.0  # measured
        self.closed = False  # the fingers are together as far as a bar lets them and have come to rest
        self.command = np.zeros(8)
        self.freedom = 1.0  # how much noise the present movement bears, in [LEAST_FREEDOM, 1]

    def measure(self, env: BimanualEnvironment, state: np.ndarray) -> None:
        self.pose = self._task.grip_pose(env.physics, self.side)
        self.joints = np.array(state[ARM[self.side]], dtype=np.float64)
        opening = float(state[GRIPPER[self.side]])
        self.closed = opening < HELD_OPENING and abs(opening - self.opening) < 0.01
        self.opening = opening

    def move(self, goal: Pose, opening: float, speed: float, turn_speed: float = TURN_SPEED) -> None:
        """Commands a step towards `goal` [speeds in m/s, rad/s] and a gripper opening [0, 1]."""
        away = float(np.linalg.norm(goal.position - self.pose.position))
        self.freedom = float(np.clip(away / FREE_DISTANCE, LEAST_FREEDOM, 1))
        ahead = _shorten(goal.position - self.pose.position, speed * CARROT_S)
        turn = _shorten(rotation_vector(goal.rotation @ self.pose.rotation.T), turn_speed * CARROT_S)
        carrot = Pose(self.pose.position + ahead, rotation_matrix(turn) @ self.pose.rotation)
        self.command = np.append(self._kinematics.solve(carrot, self.joints), opening)

    def reach(self, goal: Pose, height: float, speed: float, *, reopens: bool = False) -> None:
        """Commands a step of coming down on `goal` and, there, of closing the gripper.

        The hand comes down in a funnel, up to `height` [m] high: the closer it is in the plane and in yaw, the lower it
        may be. A hand that `reopens` may come from a grasp of nothing: it goes up while it is not open.
        """
        aside = np.linalg.norm(goal.position[:2] - self.pose.position[:2])
        turn = np.linalg.norm(rotation_vector(goal.rotation @ self.pose.rotation.T))
        away = max(aside / 0.02, turn / 0.25) - 0.3
        ready = self.is_at(goal, 0.007, 0.08) or (self.opening < OPEN and self.is_at(goal, 0.02, 0.3))
        if reopens and not ready and self.opening < OPEN:
            away = 1.0
        above = Pose(goal.position + np.array([0, 0, height * np.clip(away, 0, 1)]), goal.rotation)
        self.move(above, 0.0 if ready else 1.0, speed)

    def carry(self, held: Pose, goal: Pose) -> Pose:
        """Where the hand must go for the object that it holds to reach `goal`."""
        turn = goal.rotation @ held.rotation.T
        return Pose(goal.position + turn @ (self.pose.position - held.position), turn @ self.pose.rotation)

    def is_at(self, goal: Pose, distance: float, angle: float) -> bool:
        near = np.linalg.norm(goal.position - self.pose.position) < distance
        return bool(near and np.linalg.norm(rotation_vector(goal.rotation @ self.pose.rotation.T)) < angle)


def lift(held: Pose, goal: Pose, rest_height: float) -> Pose:
    """`goal`, but straight up first: what is held moves aside and turns as far as it is above `rest_height` [m]."""
    share = np.clip((held.position[2] - rest_height - 0.01) / 0.05, 0, 1)
    aside = held.position + share * (goal.position - held.position)
    turn = rotation_vector(goal.rotation @ held.rotation.T)
    return Pose(
        np.array([aside[0], aside[1], goal.position[2]]), rotation_matrix(share * turn) @ held.rotation
    )


def _shorten(vector: np.ndarray, length: float) -> np.ndarray:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)
