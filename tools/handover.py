"""Plays transfer episodes of a trained policy and counts how long after the left gripper closes the right one opens.

python tools/handover.py runs/transfer_ph32_exec16/default

The expert lets 4 control steps pass. Prints successes and failures by that number; "-" where a hand did neither.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from imfvla.actor import ChunkActor
from imfvla.episode import ACTION_NAMES, EpisodeInfo, EpisodeResult, Step
from imfvla.progress import Progress
from imfvla.rollout import run_episode
from imfvla.run_directory import RunDirectory
from imfvla.workbench import load_workbench

LEFT, RIGHT = (ACTION_NAMES.index(f"{arm}/gripper") for arm in ("left", "right"))  # 0 is closed, 1 open
MIDDLE = 0.5


class ActionLog:
    """Sink that keeps the executed actions of the last episode."""

    def begin(self, env: object, info: EpisodeInfo) -> None:
        self.actions: list[np.ndarray] = []

    def step(self, env: object, step: Step) -> None:
        self.actions.append(step.decision.executed)

    def end(self, result: EpisodeResult) -> None: ...
    def abort(self) -> None: ...


def release_delay(actions: np.ndarray) -> int | None:
    """Steps from the left gripper's closing to the right one's opening in actions (T, 16); None without either.

    Counted from the right one's first closing, since both begin open.
    """
    closed = actions < MIDDLE
    held = np.flatnonzero(closed[:, RIGHT])
    if not len(held):
        return None
    left = np.flatnonzero(closed[held[0] :, LEFT])
    right = np.flatnonzero(~closed[held[0] :, RIGHT])
    return int(right[0] - left[0]) if len(left) and len(right) else None


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a trained run of the transfer task")
    parser.add_argument("--nfe", type=int, default=1, help="evaluations of the network")
    parser.add_argument("--first-seed", type=int, default=100_000, help="of the start states")
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    env, policy = load_workbench(arguments.run, RunDirectory(arguments.run).weights_step())
    log, delays = ActionLog(), {True: Counter(), False: Counter()}
    actor = ChunkActor(policy, policy.horizon, arguments.nfe, noise_seed=0)
    with Progress("hand-overs", arguments.episodes) as progress:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.episodes):
            result = run_episode(env, actor, seed, [log], kind="rollout", config={})
            delays[result.success][release_delay(np.stack(log.actions))] += 1
            progress.advance()
    for success, counts in delays.items():
        ordered = sorted(counts.items(), key=lambda item: (item[0] is None, item[0]))
        text = ", ".join(f"{'-' if steps is None else steps}: {count}" for steps, count in ordered)
        print(f"{sum(counts.values())} {'successes' if success else 'failures'} by steps: {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
