"""Whether a policy sees what it is to take: where its chunks close a hand, and what that place follows.

Shapes: Tp predicted steps, A action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts import Expert
from imfvla.tasks.experts.base import GRASP_HEIGHT
from imfvla.tasks.experts.hand import ARM, GRIPPER
from imfvla.tasks.kinematics import about_z, yaw_of

LEADS = (4, 8, 16, 31)  # control steps before the closing
EARLY, AHEAD = (
    (16, 24, 32),
    31,
)  # control steps of the approach, and how far on the expert has turned its hands
ASIDE, TURN = 0.01, np.radians(10)
MIDDLE = 0.5  # of a gripper's opening
MOST_STEPS = 300  # of an expert that has not closed its hands

Plan = Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]  # pictures and state to a chunk (Tp, A)


@dataclass(frozen=True, slots=True)
class Pick:
    """What a hand takes from the table, and where: a point in the object's frame (3,)."""

    prop: str
    local: np.ndarray

    def goal(self, env: BimanualEnvironment) -> Pose:
        """Where the object would be held; its x axis is the object's."""
        pose = env.task.prop_pose(env.physics, self.prop)
        place = pose.at(self.local)
        return Pose(np.array([place[0], place[1], GRASP_HEIGHT]), pose.rotation)


def picks_of(env: BimanualEnvironment, expert: Expert) -> dict[str, Pick]:
    """What each hand of the expert takes from the table, at the start of an episode that both were reset to."""
    found: dict[str, Pick] = {}
    pick = expert.pick

    def seen(hand, target, grasp, bring) -> None:
        lying = {name: env.task.prop_pose(env.physics, name).position for name in env.task.props}
        prop = min(lying, key=lambda name: np.linalg.norm(lying[name] - target.position))
        found[hand.side] = Pick(prop, np.array(grasp, dtype=float))
        pick(hand, target, grasp, bring)

    expert.pick = seen
    try:
        expert.act(env, env.state(), 0)
    finally:
        del expert.pick
    return found


def probe(env: BimanualEnvironment, expert: Expert, plan: Plan, seed: int) -> list[dict[str, float]]:
    """Plays the expert from `seed` and asks `plan` before each closing: one row for each hand and lead.

    Errors [m, rad] of the place where the chunk would close, and what share of a shift or turn of object and hand it
    follows.
    """
    env.reset(seed)
    expert.reset(env, seed)
    picks = picks_of(env, expert)
    env.reset(seed)
    expert.reset(env, seed)
    states, openings = [], []
    for step in range(MOST_STEPS):
        states.append(env.physics.get_state().copy())
        decision = expert.act(env, env.state(), step)
        openings.append([decision.action[GRIPPER[side]] for side in picks])
        env.step(decision.executed)
        if (np.array(openings) < MIDDLE).any(axis=0).all():
            break
    rows = []
    for (side, pick), closed in zip(picks.items(), np.array(openings).T < MIDDLE, strict=True):
        closes = int(np.argmax(closed))
        for lead in (lead for lead in LEADS if closed.any() and lead <= closes):
            aim = partial(_aim, env, expert, plan, states[closes - lead], side, lead)
            rows.append({"hand": side, "lead": lead} | _measure(env, expert, side, pick, aim))
    return rows


def foresee(env: BimanualEnvironment, expert: Expert, plan: Plan, seed: int) -> list[dict[str, float]]:
    """Plays the expert from `seed` and asks `plan` early in the approach: one row for each hand and step.

    How a hand is turned in the chunk's entry AHEAD against the expert's action there [rad], and the latter, `wanted`.
    Later than the hand's closing nothing is said.
    """
    env.reset(seed)
    expert.reset(env, seed)
    chunks, actions = {}, []
    for step in range(EARLY[-1] + AHEAD + 1):
        if step in EARLY:
            chunks[step] = plan(env.look(), env.state())
        decision = expert.act(env, env.state(), step)
        actions.append(decision.action)
        env.step(decision.executed)
    rows = []
    for side, hand in expert.hands.items():
        for step, chunk in chunks.items():
            said, done = chunk[AHEAD], actions[step + AHEAD]
            if done[GRIPPER[side]] > MIDDLE:
                yaws = [
                    yaw_of(hand._kinematics.pose(np.float64(one[ARM[side]])).rotation) for one in (said, done)
                ]
                turned, wanted = half_turns(yaws[0] - yaws[1]), half_turns(yaws[1] - np.pi / 2)
                rows.append({"hand": side, "step": step, "turned": turned, "wanted": wanted})
    return rows


def _aim(
    env: BimanualEnvironment,
    expert: Expert,
    plan: Plan,
    state: np.ndarray,
    side: str,
    lead: int,
    change: Callable[[], None] | None = None,
) -> Pose:
    """The grip frame to which a chunk decided in the `state`, after a `change` of it, sends a hand `lead` steps on."""
    with env.physics.reset_context():
        env.physics.set_state(state)
        if change is not None:
            change()
    joints = plan(env.look(), env.state())[lead, ARM[side]]
    return expert.hands[side]._kinematics.pose(np.asarray(joints, dtype=float))


def _measure(
    env: BimanualEnvironment, expert: Expert, side: str, pick: Pick, aim: Callable[..., Pose]
) -> dict[str, float]:
    aimed = aim()
    goal, prop = pick.goal(env), env.task.prop_pose(env.physics, pick.prop)
    held = env.task.grip_pose(env.physics, side)
    joints = env.state()[ARM[side]].astype(float)
    across = goal.rotation[:, 1]
    free, arm = env.task._ids.free[pick.prop], env.task._ids.qpos[ARM[side]]

    def move_object(shift: float, turn: float) -> None:
        round_goal = about_z(turn)
        place = goal.position + round_goal @ (prop.position - goal.position) + shift * across
        yaw = yaw_of(prop.rotation) + turn
        env.physics.data.qpos[free : free + 7] = (*place, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))

    def move_hand(shift: float, turn: float) -> None:
        pose = Pose(held.position + shift * across, about_z(turn) @ held.rotation)
        env.physics.data.qpos[arm] = expert.hands[side]._kinematics.solve(pose, joints)

    row = {
        "aside": float((aimed.position - goal.position) @ across),
        "above": float(aimed.position[2] - goal.position[2]),
        "turned": half_turns(yaw_of(aimed.rotation) - yaw_of(goal.rotation) - np.pi / 2),
    }
    for name, move in (("object", move_object), ("hand", move_hand)):
        there, back = (aim(partial(move, shift, 0)) for shift in (ASIDE, -ASIDE))
        row[f"{name} aside"] = float((there.position - back.position) @ across / (2 * ASIDE))
        there, back = (aim(partial(move, 0, turn)) for turn in (TURN, -TURN))
        row[f"{name} turned"] = half_turns(yaw_of(there.rotation) - yaw_of(back.rotation)) / (2 * TURN)
    return row


def half_turns(angle: float) -> float:
    """An angle [rad] in [-pi/2, pi/2), up to half turns, which are the same to a gripper."""
    return float((angle + np.pi / 2) % np.pi - np.pi / 2)
