"""Says why a policy of one of this package's own tasks misses its grasps: whether it sees what it is to take.

python tools/grasps.py experiments/pretrained/socket_ph32_exec16/default
python tools/grasps.py experiments/pretrained/socket_ph32_exec16/default --play 100
python tools/grasps.py experiments/pretrained/socket_ph32_exec16/default --play 60 --given-grasps

The first plays the expert, stops before each closing and prints where the policy's chunk would close: its error, and by
how much that place follows the object and the hand where one of them is moved 1 cm aside or turned by 10 degrees. One
that looks follows the object (1) and not the hand (0); one that goes on from where it is follows the hand alone. Then
how well chunks early in the approach turn the hands, beside a guess of the same way for all starts.
The second plays the policy and prints how high, how far aside and how much turned hands close, and which grasps fail;
with --given-grasps the expert plays until the objects are held.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from imfvla.config.protocol import FRESH, NOISES, REPORTING_FIRST_SEED, SELECTION_FIRST_SEED
from imfvla.environments.rollout import run_episode
from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.modes.recordings import settings_of
from imfvla.modes.sight import LEADS, MIDDLE, foresee, half_turns, picks_of, probe
from imfvla.process.progress import Progress
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.workbench import load_workbench
from imfvla.sources.demonstrations import BimanualSettings
from imfvla.storage.run_directory import RunDirectory
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts import Expert, make_expert
from imfvla.tasks.experts.hand import GRIPPER
from imfvla.tasks.kinematics import yaw_of

HELD_AFTER = 25  # control steps after the closing
HEIGHTS_MM = (0, 16, 20, 24, 28, 60)


class Closings:
    """Sink that keeps, for each hand of `picks`, how it is placed where it is first told to close, and what it holds.

    `rows` of (height above the table, aside, turned, whether it holds its object HELD_AFTER steps later).
    """

    def __init__(self, expert: Expert) -> None:
        self._expert, self.rows = expert, {}

    def begin(self, env: BimanualEnvironment, info: EpisodeInfo) -> None:
        self._expert.reset(env, info.seed)
        self.picks = picks_of(env, self._expert)
        self.rows, self._closed = {}, {}
        self._look(env)

    def step(self, env: BimanualEnvironment, step: Step) -> None:
        for side, pick in self.picks.items():
            if side not in self._closed and step.decision.executed[GRIPPER[side]] < MIDDLE:
                self._closed[side] = step.index
                self.rows[side] = (*self._placed[side], False)
            if step.index == self._closed.get(side, step.index) + HELD_AFTER:
                held = env.task.holds(env.task.contacts(env.physics), side, pick.prop)
                self.rows[side] = (*self.rows[side][:-1], held)
        self._look(env)

    def _look(self, env: BimanualEnvironment) -> None:
        self._placed = {}
        for side, pick in self.picks.items():
            goal, hand = pick.goal(env), env.task.grip_pose(env.physics, side)
            aside = float((hand.position - goal.position) @ goal.rotation[:, 1])
            turned = half_turns(yaw_of(hand.rotation) - yaw_of(goal.rotation) - np.pi / 2)
            self._placed[side] = (float(hand.position[2]), aside, turned)

    def end(self, result: EpisodeResult) -> None: ...
    def abort(self) -> None: ...


class GivenGrasps:
    """An actor that lets the expert play until every hand that takes something from the table holds it."""

    def __init__(self, actor: ChunkActor, expert: Expert, exec_steps: int) -> None:
        self._actor, self._expert, self._exec = actor, expert, exec_steps

    def reset(self, env: BimanualEnvironment, seed: int) -> None:
        self._actor.reset(env, seed)
        self._expert.reset(env, seed)
        self._picks = picks_of(env, self._expert)
        self._expert.reset(env, seed)
        self._begun = False

    def act(self, env: BimanualEnvironment, state: np.ndarray, step: int) -> Decision:
        if not self._begun and step % self._exec == 0:
            contacts, hands = env.task.contacts(env.physics), self._expert.hands
            self._begun = all(
                hands[side].closed and env.task.holds(contacts, side, pick.prop)
                for side, pick in self._picks.items()
            )
        return (self._actor if self._begun else self._expert).act(env, state, step)


def print_aims(rows: list[dict[str, float]]) -> None:
    print(
        "hand   steps    n  aside [mm]  above [mm]  turned [deg]  follows object: aside turned  hand: aside turned"
    )
    for side, lead in sorted({(row["hand"], row["lead"]) for row in rows}):
        chosen = [row for row in rows if (row["hand"], row["lead"]) == (side, lead)]
        column = {key: np.array([row[key] for row in chosen]) for key in chosen[0] if key != "hand"}
        rms = {key: np.sqrt(np.mean(column[key] ** 2)) for key in ("aside", "turned")}
        above = 1e3 * column["above"]
        print(
            f"{side:6} {lead:5d} {len(chosen):4d}  {1e3 * rms['aside']:10.1f}  "
            f"{above.mean():5.1f}+-{above.std():<4.1f} {np.degrees(rms['turned']):12.1f}"
            f"{column['object aside'].mean():23.2f} {column['object turned'].mean():6.2f}"
            f"{column['hand aside'].mean():13.2f} {column['hand turned'].mean():6.2f}"
        )


def print_turns(rows: list[dict[str, float]]) -> None:
    print("hand   step of the decision    n  turned [deg], rms  a guess")
    for side, step in sorted({(row["hand"], row["step"]) for row in rows}):
        chosen = [row for row in rows if (row["hand"], row["step"]) == (side, step)]
        rms = np.degrees(np.sqrt(np.mean([row["turned"] ** 2 for row in chosen])))
        guess = np.degrees(np.std([row["wanted"] for row in chosen]))
        print(f"{side:6} {step:20d} {len(chosen):4d} {rms:18.1f} {guess:8.1f}")


def print_closings(found: list[tuple[bool, dict[str, tuple]]]) -> None:
    print(f"{sum(success for success, _ in found)} successes of {len(found)}")
    for side in sorted({side for _, rows in found for side in rows}):
        rows = np.array([(*rows[side], success) for success, rows in found if side in rows], dtype=float)
        missed = rows[:, 3] == 0
        for name, values in (("aside [mm]", 1e3 * rows[:, 1]), ("turned [deg]", np.degrees(rows[:, 2]))):
            print(f"{side} hand closes {name}: half of all below {np.percentile(abs(values), 50):.0f}, "
                  f"nine of ten below {np.percentile(abs(values), 90):.0f}")  # fmt: skip
        for low, high in pairwise(HEIGHTS_MM):
            here = (1e3 * rows[:, 0] >= low) & (1e3 * rows[:, 0] < high)
            print(f"    {low} to {high} mm above the table: {here.sum()} closings, {(here & missed).sum()} of them "
                  f"miss, {(here & (rows[:, 4] == 0)).sum()} episodes fail")  # fmt: skip


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "run", type=Path, help="directory of a trained run of one of this package's own tasks"
    )
    parser.add_argument("--nfe", type=int, default=1, help="network steps per chunk")
    parser.add_argument("--noise", choices=NOISES, default=FRESH, help="that a chunk starts from")
    parser.add_argument("--first-seed", type=int, default=SELECTION_FIRST_SEED, help="of the start states")
    parser.add_argument("--episodes", type=int, default=14, help="of the expert")
    parser.add_argument("--play", type=int, help="episodes of the policy to play instead")
    parser.add_argument(
        "--given-grasps", action="store_true", help="the expert plays until the objects are held"
    )
    arguments = parser.parse_args()
    episodes = arguments.play or arguments.episodes
    if arguments.first_seed + episodes > REPORTING_FIRST_SEED:
        raise UserError(
            f"--first-seed and episodes must stay below {REPORTING_FIRST_SEED}: the rest is for reporting."
        )
    directory = RunDirectory(arguments.run)
    expert, watched = (_expert_of(settings_of(directory.config())) for _ in range(2))
    env, policy = load_workbench(arguments.run, directory.weights_step())
    if policy.horizon.obs != 1 or policy.horizon.pred <= max(LEADS):
        raise UserError(
            f"The policy must see one step and predict more than {max(LEADS)}, found {policy.horizon}."
        )
    actor = ChunkActor(policy, policy.horizon, arguments.nfe, noise_seed=0, noise=arguments.noise)
    seeds, found, early = range(arguments.first_seed, arguments.first_seed + episodes), [], []
    with Progress("episodes", episodes) as progress:
        for seed in seeds:
            if arguments.play:
                log = Closings(watched)
                player = GivenGrasps(actor, expert, policy.horizon.exec) if arguments.given_grasps else actor
                result = run_episode(env, player, seed, [log], kind="rollout", config={})
                found.append((result.success, log.rows))
            else:
                env.reset(seed)
                actor.reset(env, seed)
                found += probe(env, expert, partial(_plan, actor, policy.views), seed)
                early += foresee(env, expert, partial(_plan, actor, policy.views), seed)
            progress.advance()
    if arguments.play:
        print_closings(found)
    else:
        print_aims(found)
        print_turns(early)
    return 0


def _expert_of(settings: BimanualSettings) -> Expert:
    """The expert of a run, for which nothing goes wrong."""
    return make_expert(
        settings.task, modes=settings.modes, noise=settings.noise, hold=settings.hold, dwell=settings.dwell
    )


def _plan(
    actor: ChunkActor, views: tuple[str, ...], images: dict[str, np.ndarray], state: np.ndarray
) -> np.ndarray:
    return actor.plan([[images[view] for view in views]], [state], 0)[0]


if __name__ == "__main__":
    sys.exit(main())
