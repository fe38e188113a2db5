"""Plays transfer episodes of a trained policy and counts how long after the left gripper closes the right one opens.

python tools/handover.py runs/transfer_ph32_exec16/default

The expert lets 4 control steps pass. Prints successes and failures by that number; "-" where a hand did neither.
What single samples do at recorded observations says tools/modes.py.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from imfvla.config.protocol import REPORTING_FIRST_SEED
from imfvla.environments.rollout import run_episode
from imfvla.episode import EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.modes.grippers import grippers_of, release_delay
from imfvla.process.progress import Progress
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.workbench import load_workbench
from imfvla.storage.run_directory import RunDirectory


class ActionLog:
    """Sink that keeps the executed actions of the last episode."""

    def begin(self, env: object, info: EpisodeInfo) -> None:
        self.actions: list[np.ndarray] = []

    def step(self, env: object, step: Step) -> None:
        self.actions.append(step.decision.executed)

    def end(self, result: EpisodeResult) -> None: ...
    def abort(self) -> None: ...


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a trained run of the transfer task")
    parser.add_argument("--nfe", type=int, default=1, help="network steps per chunk")
    parser.add_argument("--first-seed", type=int, default=REPORTING_FIRST_SEED, help="of the start states")
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    env, policy = load_workbench(arguments.run, RunDirectory(arguments.run).weights_step())
    grippers = grippers_of(env.robot)
    if len(grippers) != 2:
        raise UserError(
            f"The run must be of a robot with two grippers, found {len(grippers)} in {arguments.run}."
        )
    taking, giving = grippers  # the left hand takes
    log, delays = ActionLog(), {True: Counter(), False: Counter()}
    actor = ChunkActor(policy, policy.horizon, arguments.nfe, noise_seed=0)
    with Progress("hand-overs", arguments.episodes) as progress:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.episodes):
            result = run_episode(env, actor, seed, [log], kind="rollout", config={})
            delays[result.success][release_delay(np.stack(log.actions), taking, giving)] += 1
            progress.advance()
    for success, counts in delays.items():
        ordered = sorted(counts.items(), key=lambda item: (item[0] is None, item[0]))
        text = ", ".join(f"{'-' if steps is None else steps}: {count}" for steps, count in ordered)
        print(f"{sum(counts.values())} {'successes' if success else 'failures'} by steps: {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
