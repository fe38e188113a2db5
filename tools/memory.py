"""Shows whether memory stays flat: over many resets of a task, and over many steps of training.

python tools/memory.py resets --count 2000           # each with two control steps and a look through the cameras
python tools/memory.py training --count 2000         # the policy of conf/train.yaml on small pictures of noise

Prints the resident memory ten times, and exits with 1 where the last three quarters grew by more than 5 %.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from imfvla.command.composition import compose
from imfvla.policy import build_policy
from imfvla.sources.mcap import McapSource
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.data import make_loader, prepare_windows
from imfvla.training.experiment import read_experiment
from imfvla.training.loop import Trainer

Watch = Callable[[], None]
ALLOWED_GROWTH = 0.05
PARTS = 10


class Watched:
    """Batches that report each one that is taken."""

    def __init__(self, batches: Any, watch: Watch) -> None:
        self._batches, self._watch = batches, watch

    def __next__(self) -> Any:
        self._watch()
        return next(self._batches)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batches, name)


def resets(count: int, watch: Watch) -> None:
    """One reset after the other, as an evaluation makes them."""
    from imfvla import tasks  # here, since a GL backend is picked at import

    env = tasks.load("socket", image_size=(32, 32))
    action = np.zeros(len(env.robot.action))
    for seed in range(100_000, 100_000 + count):
        env.reset(seed)
        env.look()
        for _ in range(2):
            env.step(action)
        watch()


def training(count: int, watch: Watch) -> None:
    """One step of the training loop after the other, a state saved now and then."""
    root = Path(__file__).resolve().parent.parent
    sys.path.insert(0, str(root / "tests"))  # the recordings that the tests train on
    from synthetic import write_demonstrations

    sizes = [f"training.steps={count}", "training.batch_size=2", "observation.image_size=[32,32]"]
    pace = [
        "training.threads=1",
        "training.save_every_s=5",
        "training.checkpoints=10",
        "training.log_every=10",
    ]
    config = compose("train", [*sizes, *pace])
    options = read_experiment(config)
    with tempfile.TemporaryDirectory(prefix="imfvla-memory-") as folder:
        windows = prepare_windows(config, McapSource.of(write_demonstrations(Path(folder) / "demos")))
        Trainer(
            build_policy(config, windows.statistics()),
            Watched(make_loader(options, windows), watch),
            RunDirectory(Path(folder) / "run"),
            options.training,
            options.optim,
            seed=0,
            description={},
        ).train()


def measure(work: Callable[[int, Watch], None], count: int) -> list[float]:
    """Resident memory [MiB] at each tenth of the work."""
    found: list[float] = []
    done = 0

    def watch() -> None:
        nonlocal done
        done += 1
        if done * PARTS // count > len(found):
            found.append(psutil.Process().memory_info().rss / 2**20)
            print(f"{done:6} done  {found[-1]:7.1f} MiB", flush=True)

    work(count, watch)
    return found


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("resets", "training"))
    parser.add_argument("--count", type=int, default=2000)
    options = parser.parse_args()
    found = measure({"resets": resets, "training": training}[options.what], options.count)
    settled = found[len(found) // 4]
    growth = found[-1] / settled - 1
    print(
        json.dumps(
            {"what": options.what, "count": options.count, "mib": [round(value, 1) for value in found]}
        )
    )
    print(f"grew by {100 * growth:.1f} % over the last three quarters")
    return 1 if growth > ALLOWED_GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
