"""Kills, stops and starves real processes of this project, resumes them, and compares with an undisturbed run.

python tools/chaos.py                          # everything
python tools/chaos.py training --kills 50      # one kind of work

training, collection, evaluation   SIGKILL at random moments, every second time while a file is being written
sweep                              the same over six trainings and evaluations of one command
torchrun                           SIGKILL of one of two processes at random moments, a fifth as often; torchrun
                                   restarts both. One training with the whole policy in each, one with a part in each
stops                              Ctrl-C, SIGTERM and SIGUSR1 in the middle of training: seconds to the end, exit code
disk                               a full file system, a read-only one (both mounted, where permitted) and no file
                                   handles left
space                              a small disk (mounted) that is full again and again while it grows, for every kind of
                                   work
workers                            worker processes that die and hang in the middle of an evaluation
changes                            data, rows, numbers, config, weights and code that change silently
leftovers                          SIGKILL within the writing of a state, always; what is left is counted
strangers                          a link that leads out, a pipe, a socket, a device, a directory or 8 GB of zeros in
                                   place of a file of a run directory, four times as often
folders                            SIGKILL in conversions and exports, which leave a whole folder or none; four of them
                                   that make one folder at once
publications                       four commands that publish into one folder at once
reports                            reports in a loop over a run that is being trained and evaluated
no_locks                           a file system without locks
nfs                                frame stores that are replaced while in use, where open files cannot be deleted
fuse                               kills and replaced stores on a FUSE mount (bindfs), a fifth as often

Processes are forked after everything is imported, so that the signals hit the work itself. The policy is the tiny one
of the tests (in a sweep a small one that is composed), and its environment replaces the simulator; loop,
checkpoints, recordings and logs are the real ones. Prints a line for each fault and exits with 1 where anything
differs.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import random
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "tests"), str(ROOT / "tests" / "training")]
from faults.changes import changes  # noqa: E402
from faults.disk import disk  # noqa: E402
from faults.folders import folders  # noqa: E402
from faults.fuse import fuse  # noqa: E402
from faults.killing import kills_of  # noqa: E402
from faults.leftovers import leftovers  # noqa: E402
from faults.outcome import Differs, demonstrations_of, rows_of, state_of  # noqa: E402
from faults.reports import reports  # noqa: E402
from faults.sharing import nfs, no_locks, publications  # noqa: E402
from faults.space import space  # noqa: E402
from faults.stops import stops  # noqa: E402
from faults.strangers import strangers  # noqa: E402
from faults.sweep import sweep  # noqa: E402
from faults.torchrun import torchrun  # noqa: E402
from faults.work import collect, roll_out, train  # noqa: E402
from faults.workers import workers  # noqa: E402

FAULTS: dict[str, Callable[[Path, int, random.Random], str]] = {
    "training": kills_of(partial(train, steps=150), state_of, 150),
    "collection": kills_of(partial(collect, episodes=40), demonstrations_of, 40),
    "evaluation": kills_of(partial(roll_out, episodes=150), rows_of, 150),
    "sweep": sweep,
    "torchrun": torchrun,
    "stops": stops,
    "disk": disk,
    "space": space,
    "workers": workers,
    "changes": changes,
    "leftovers": leftovers,
    "strangers": strangers,
    "folders": folders,
    "publications": publications,
    "no_locks": no_locks,
    "reports": reports,
    "nfs": nfs,
    "fuse": fuse,
}


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="*", help=f"of {', '.join(FAULTS)}; all by default")
    parser.add_argument(
        "--kills", type=int, default=50, help="over one training, collection, evaluation, sweep"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    if unknown := set(options.what) - FAULTS.keys():
        parser.error(f"no {', '.join(unknown)}; there are {', '.join(FAULTS)}")
    torch.set_num_threads(1)  # before the first fork: threads do not survive one
    with tempfile.TemporaryDirectory(prefix="imfvla-chaos-") as folder:
        train(Path(folder), steps=4)  # what is imported and looked up once is there in every process
    failed = 0
    for what in options.what or FAULTS:
        with tempfile.TemporaryDirectory(prefix="imfvla-chaos-") as folder:
            try:
                words = FAULTS[what](Path(folder), options.kills, random.Random(options.seed))
            except Differs as problem:
                failed, words = failed + 1, f"FAILED: {problem}"
        print(f"{what}: {words}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
