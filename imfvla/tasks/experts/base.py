"""What the scripted experts share: style drawn from the seed, one controlled hand per arm, action noise.

An expert decides from the measured state alone, not from a clock, so that a policy that sees one frame can learn it.
Only a grasp that fails on purpose is not of this kind, and its steps are marked as nothing to imitate.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from imfvla.episode import ActionError, Decision
from imfvla.errors import UserError
from imfvla.tasks.bimanual import SIDES, Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.hand import ARM, Hand
from imfvla.tasks.experts.miss import Miss
from imfvla.tasks.kinematics import ArmKinematics, about_z

SPEED = 0.125  # m/s
GRASP_HEIGHT = 0.014  # of the point between the fingertips above the table
NOISE_CORRELATION = 0.9  # of the action noise from one control step to the next
_STYLE_STREAM, _NOISE_STREAM, _MISS_STREAM = 11, 12, 13


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
        recoveries: share of the demonstrations in which a first grasp fails and the expert grasps again; which ones is
            drawn from the seed. Until the last hand that missed goes back, steps are marked as nothing to imitate.
        max_turn: by how much the target of a joint may change from one control step to the next [rad]. A demonstration
            in which it changes more has failed, as where a wrist passes a singularity; None refuses nothing.
    """

    task_name: str
    dwells = False  # whether `dwell` may be above 0
    # which hands may miss, the one or the other or both together; one is drawn
    misses: tuple[tuple[str, ...], ...] = (("right",),)

    def __init__(
        self,
        *,
        modes: int,
        noise: float,
        hold: int,
        dwell: int,
        recoveries: float = 0,
        max_turn: float | None = None,
    ) -> None:
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
        if not 0 <= recoveries <= 1:
            raise UserError(
                f"task.expert.recoveries is a share of the demonstrations, 0 to 1, found {recoveries!r}."
            )
        if max_turn is not None and not max_turn > 0:
            raise UserError(
                f"task.expert.max_turn is a joint angle [rad] above 0, or null for any, found {max_turn!r}."
            )
        self.modes, self.noise, self.hold, self.dwell = modes, noise, hold, dwell
        self.recoveries, self.max_turn = recoveries, max_turn
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
        rng = np.random.default_rng(np.random.SeedSequence([seed, _MISS_STREAM]))
        missing = self.misses[rng.integers(len(self.misses))] if rng.random() < self.recoveries else ()
        self._misses = {side: Miss(side, rng) for side in missing}
        if missing:
            self.style["missed"] = list(missing)
        self._noise_rng = np.random.default_rng(np.random.SeedSequence([seed, _NOISE_STREAM]))
        self._disturbance = np.zeros(len(env.robot.action))
        self._limits = tuple(np.float32(limits) for limits in (env.robot.action_min, env.robot.action_max))
        self._steps_since_success = -1
        self._last_joints: np.ndarray | None = None

    def draw_style(self, rng: np.random.Generator) -> Mapping[str, float]:
        """Draws what varies besides mode, speed and approach height."""
        raise NotImplementedError

    def command(self, env: BimanualEnvironment, contacts: np.ndarray) -> None:
        """Moves `self.hands` by one control step."""
        raise NotImplementedError

    def act(self, env: BimanualEnvironment, state: np.ndarray, step: int) -> Decision:
        """The clean action, and the same with smooth joint noise to be executed. ActionError beyond `max_turn`."""
        for hand in self.hands.values():
            hand.measure(env, state)
        # Of a demonstration without a miss nothing is said.
        imitate = all(miss.over for miss in self._misses.values()) if self._misses else None
        self.command(env, self.task.contacts(env.physics))
        clean = np.concatenate([self.hands[side].command for side in SIDES])
        fresh = self._noise_rng.standard_normal(len(self._disturbance))
        self._disturbance = NOISE_CORRELATION * self._disturbance + np.sqrt(1 - NOISE_CORRELATION**2) * fresh
        scale = np.zeros(len(self._disturbance))
        for side in SIDES:
            scale[ARM[side]] = self.noise * self.hands[side].freedom
        disturbed = clean + scale * self._disturbance
        clean, disturbed = (np.clip(a, *self._limits).astype(np.float32) for a in (clean, disturbed))
        self._refuse_jump(np.concatenate([clean[ARM[side]] for side in SIDES]))
        return Decision(action=clean, executed=disturbed, imitate=imitate)

    def _refuse_jump(self, joints: np.ndarray) -> None:
        last, self._last_joints = self._last_joints, joints
        if last is None or self.max_turn is None:
            return
        turn = float(np.abs(joints - last).max())
        if turn > self.max_turn:
            raise ActionError(f"a joint's target jumps by {turn:.2f} rad")

    def done(self, env: BimanualEnvironment) -> bool:
        """Whether success has been held long enough to end the demonstration; to be asked once after each step."""
        if self._steps_since_success >= 0 or env.stage() >= len(env.stages):
            self._steps_since_success += 1
        return self._steps_since_success >= self.hold

    def pick(self, hand: Hand, target: Pose, grasp: np.ndarray, bring: np.ndarray) -> None:
        """Commands the approach to the point `grasp` (3,) of an object on the table and the closing of the gripper.

        `bring` (3,) is where the object goes next, along the axes of the world: a hand that misses sets out for there.
        """
        yaw = np.arctan2(target.rotation[1, 0], target.rotation[0, 0]) + self.turn[hand.side] * np.pi / 2
        at = target.at(grasp)
        goal = Pose(np.array([at[0], at[1], GRASP_HEIGHT]), about_z(yaw))
        miss = self._misses.get(hand.side)
        if miss is not None and not miss.over:
            carried = Pose(bring + grasp, about_z(self.turn[hand.side] * np.pi / 2))
            miss.play(hand, goal, carried, self.height, self.speed)
        else:
            hand.reach(goal, self.height, self.speed, reopens=miss is not None)
