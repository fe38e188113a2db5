"""What the scripted experts share: style drawn from the seed, one controlled hand per arm, action noise.

An expert decides from the measured state alone, not from a clock, so that a policy that sees one frame can learn it.
Each hand is pulled towards a goal by a carrot: the commanded pose lies ahead of the measured one by at most the
distance that is covered within the arm's lag. Drift and noise are thereby corrected in the recorded actions.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from imfvla.episode import Decision
from imfvla.errors import UserError
from imfvla.tasks.bimanual import SIDES, BimanualTask, Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.kinematics import ArmKinematics, about_z, rotation_matrix, rotation_vector
from imfvla.tasks.robot import home_joints

CARROT_S = 0.065  # the arms' lag and half a control step: how far ahead of the hand its command lies
SPEED, TURN_SPEED = 0.125, 2.0  # m/s, rad/s
GRASP_HEIGHT = 0.014  # of the point between the fingertips above the table
HELD_OPENING = 0.33  # a gripper around a bar measures 0.27
NOISE_CORRELATION = 0.9  # of the action noise from one control step to the next
# full noise this far [m] from the goal, this share of it at the goal
FREE_DISTANCE, LEAST_FREEDOM = 0.08, 0.2
_STYLE_STREAM, _NOISE_STREAM = 11, 12
_ARM = {"left": slice(0, 7), "right": slice(8, 15)}
_GRIPPER = {"left": 7, "right": 15}


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
        self.joints = np.array(state[_ARM[self.side]], dtype=np.float64)
        opening = float(state[_GRIPPER[self.side]])
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

    def carry(self, held: Pose, goal: Pose) -> Pose:
        """Where the hand must go for the object that it holds to reach `goal`."""
        turn = goal.rotation @ held.rotation.T
        return Pose(goal.position + turn @ (self.pose.position - held.position), turn @ self.pose.rotation)

    def is_at(self, goal: Pose, distance: float, angle: float) -> bool:
        near = np.linalg.norm(goal.position - self.pose.position) < distance
        return bool(near and np.linalg.norm(rotation_vector(goal.rotation @ self.pose.rotation.T)) < angle)


class Expert:
    """Base of the experts, an `episode.Actor`. Subclasses draw their style and command both hands.

    Args:
        modes: 1 each gripper turns the same way in every episode; 2 the right one's way is drawn from the seed;
            4 both are drawn, independently. Nothing in the observation shows what was drawn.
        noise: standard deviation [rad] of the joint noise that is executed but not recorded as action.
        hold: control steps for which a demonstration continues after success, so that it shows holding too.
        dwell: mean of the geometric time [control steps] that an expert waits before it hands over: with its left hand
            around the bar before it closes (transfer), with both hands on the bar before one lets go (either_arm); 0
            waits for nothing. Nothing in the observation shows how long it will wait.
    """

    task_name: str
    dwells = False  # whether `dwell` may be above 0

    def __init__(self, *, modes: int, noise: float, hold: int, dwell: int) -> None:
        if modes not in (1, 2, 4):
            raise UserError(f"task.expert.modes must be 1, 2 or 4, found {modes!r}.")
        if not 0 <= noise <= 0.05:
            raise UserError(f"task.expert.noise is a joint angle [rad] from 0 to 0.05, found {noise!r}.")
        if hold < 1:
            raise UserError(f"task.expert.hold is a number of control steps, at least 1, found {hold!r}.")
        if dwell < 0 or (dwell and not self.dwells):
            wanted = (
                "at least 0 control steps" if self.dwells else "0: only those of transfer and either_arm wait"
            )
            raise UserError(f"task.expert.dwell must be {wanted}, found {dwell!r}.")
        self.modes, self.noise, self.hold, self.dwell = modes, noise, hold, dwell
        self.style: dict[str, Any] = {}
        self.hands: dict[str, Hand] = {}

    def reset(self, env: BimanualEnvironment, seed: int) -> None:
        """Draws the style of the episode `seed` and forgets the last one."""
        task = env.task
        if task.goal != self.task_name:
            raise UserError(f"The expert of {self.task_name!r} was given the task {task.goal!r}.")
        self.task = task
        self.hands = {side: Hand(task, side, ArmKinematics(env.physics.model.ptr, side)) for side in SIDES}
        rng = np.random.default_rng(np.random.SeedSequence([seed, _STYLE_STREAM]))
        # always drawn, so that the rest of the style is the same in all modes
        signs = rng.choice([-1, 1], size=2)
        # the hidden mode: which of its two equivalent yaws each gripper takes
        self.turn = {
            "left": float(signs[0]) if self.modes == 4 else 1.0,
            "right": float(signs[1]) if self.modes >= 2 else 1.0,
        }
        self.speed = SPEED * rng.uniform(0.87, 1.15)
        self.height = rng.uniform(0.05, 0.08)
        self.style = {
            "turn_left": self.turn["left"],
            "turn_right": self.turn["right"],
            "speed": self.speed,
            "height": self.height,
            **self.draw_style(rng),
        }
        self._noise_rng = np.random.default_rng(np.random.SeedSequence([seed, _NOISE_STREAM]))
        self._disturbance = np.zeros(len(env.robot.action))
        self._limits = tuple(np.float32(limits) for limits in (env.robot.action_min, env.robot.action_max))
        self._steps_since_success = -1

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        """Draws what varies besides mode, speed and approach height."""
        raise NotImplementedError

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        """Moves `self.hands` by one control step."""
        raise NotImplementedError

    def act(self, env: BimanualEnvironment, state: np.ndarray, step: int) -> Decision:
        """The clean action, and the same with smooth joint noise to be executed."""
        for hand in self.hands.values():
            hand.measure(env, state)
        self.command(env, self.task.contacts(env.physics))
        clean = np.concatenate([self.hands[side].command for side in SIDES])
        fresh = self._noise_rng.standard_normal(len(self._disturbance))
        self._disturbance = NOISE_CORRELATION * self._disturbance + np.sqrt(1 - NOISE_CORRELATION**2) * fresh
        scale = np.zeros(len(self._disturbance))
        for side in SIDES:
            scale[_ARM[side]] = self.noise * self.hands[side].freedom
        disturbed = clean + scale * self._disturbance
        clean, disturbed = (np.clip(a, *self._limits).astype(np.float32) for a in (clean, disturbed))
        return Decision(action=clean, executed=disturbed)

    def done(self, env: BimanualEnvironment) -> bool:
        """Whether success has been held long enough to end the demonstration; to be asked once after each step."""
        if self._steps_since_success >= 0 or env.stage() >= len(env.stages):
            self._steps_since_success += 1
        return self._steps_since_success >= self.hold

    def pick(self, hand: Hand, target: Pose, grasp: np.ndarray) -> Pose:
        """Commands the approach to the point `grasp` (3,) of an object on the table and the closing of the gripper.

        The hand comes down in a funnel: the closer it is in the plane and in yaw, the lower it may be.
        """
        yaw = np.arctan2(target.rotation[1, 0], target.rotation[0, 0]) + self.turn[hand.side] * np.pi / 2
        at = target.at(grasp)
        goal = Pose(np.array([at[0], at[1], GRASP_HEIGHT]), about_z(yaw))
        aside = np.linalg.norm(goal.position[:2] - hand.pose.position[:2])
        turn = np.linalg.norm(rotation_vector(goal.rotation @ hand.pose.rotation.T))
        away = max(aside / 0.02, turn / 0.25) - 0.3
        above = Pose(goal.position + np.array([0, 0, self.height * np.clip(away, 0, 1)]), goal.rotation)
        ready = hand.is_at(goal, 0.007, 0.08) or (hand.opening < 0.6 and hand.is_at(goal, 0.02, 0.3))
        hand.move(above, 0.0 if ready else 1.0, self.speed)
        return goal

    def lift(self, held: Pose, goal: Pose, rest_height: float) -> Pose:
        """`goal`, but straight up first: the object moves aside and turns as far as it has been lifted."""
        share = np.clip((held.position[2] - rest_height - 0.01) / 0.05, 0, 1)
        aside = held.position + share * (goal.position - held.position)
        turn = rotation_vector(goal.rotation @ held.rotation.T)
        return Pose(
            np.array([aside[0], aside[1], goal.position[2]]), rotation_matrix(share * turn) @ held.rotation
        )


def _shorten(vector: np.ndarray, length: float) -> np.ndarray:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)
