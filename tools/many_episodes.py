"""How long a training takes to start, and what memory it takes, with few and with many demonstrations (Linux).

python tools/many_episodes.py                     # 200 and 20,000 episodes of 300 steps
python tools/many_episodes.py --episodes 1000

Writes a frame store of drawn episodes with black pictures of 8 x 8 pixels, which take no disk space. Then a fresh
process for each number of episodes does what a training does until its first step: opens the store, fits the
normalisers, builds the policy, takes a batch. Prints the time of this from the start of the process, imports included,
and the processor's time, of the whole and of its parts; the peak of its resident memory, and without the pages of the
store's files, which the system can drop; the median time of preparing a batch.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap

from imfvla.robot import RobotSpec
from imfvla.sources.base import EpisodeArrays

STEPS = 300
SIZE = (8, 8)  # (H, W) [px]
SENTENCES = ("put the peg into the socket", "insert the peg", "push the peg into the hole")
BATCHES = 200
MIB = 2**20


class Drawn:
    """An `EpisodeSource` whose store `write_store` has made, so that no episode is asked for."""

    def __init__(self, robot: RobotSpec, episodes: int) -> None:
        self.robot, self._episodes = robot, episodes

    def __len__(self) -> int:
        return self._episodes

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        raise AssertionError("the store is out of date")

    def num_frames(self, index: int) -> int:
        return STEPS

    def digest(self) -> str:
        return f"{self._episodes:012d}"


def prepare(episodes: int, folder: Path) -> tuple[dict[str, Any], Drawn, dict[str, float]]:
    """The config of a training, the episodes, and the time that importing what it needs took."""
    parts: dict[str, float] = {}
    with timed(parts, "imports"):
        from imfvla.command.composition import compose
        from imfvla.robot_of import robot_of
        from imfvla.training.loop import Trainer  # noqa: F401, a training imports it
    pictures = ["observation.views=[front]", f"observation.image_size={list(SIZE)}"]
    config = compose("train", [*pictures, f"demos.frames_directory={folder}"])
    return config, Drawn(robot_of(config), episodes), parts


def write_store(episodes: int, folder: Path) -> None:
    """The arrays of a frame store: walks, actions that follow them, and a sparse file of black pictures."""
    from imfvla.data.checksums import with_checksums
    from imfvla.data.store_format import ARRAYS, IMAGES, meta_of
    from imfvla.training.data import store_path

    config, source, _ = prepare(episodes, folder)
    views, rows, robot = tuple(config["observation"]["views"]), episodes * STEPS, source.robot
    path = store_path(config, source)
    path.mkdir(parents=True, exist_ok=True)
    with open(path / IMAGES, "wb") as stream:
        stream.truncate(rows * len(views) * 3 * math.prod(SIZE))
    np.save(path / "image_steps.npy", np.tile(np.arange(STEPS), episodes), allow_pickle=False)
    state = open_memmap(path / "state.npy", "w+", np.float32, (rows, len(robot.state)))
    action = open_memmap(path / "action.npy", "w+", np.float32, (rows, len(robot.action)))
    for index in range(episodes):
        rng = np.random.default_rng(index)
        own = slice(index * STEPS, (index + 1) * STEPS)
        state[own] = walk = 0.02 * rng.normal(size=(STEPS, len(robot.state))).cumsum(axis=0)
        action[own] = walk[:, robot.origin] + 0.02 * rng.normal(size=(STEPS, len(robot.action)))
    entry = {"task": "socket", "instructions": SENTENCES, "num_steps": STEPS, "num_frames": STEPS}
    entries = [{"name": f"episode {index}", **entry} for index in range(episodes)]
    state.flush()
    action.flush()
    meta = with_checksums({**meta_of(source, views, SIZE), "episodes": entries}, path, ARRAYS)
    (path / "meta.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")


def start(episodes: int, folder: Path, began: float) -> dict[str, Any]:
    """Starts a training on a store that is there, `began` at that time [s since the epoch], and measures."""
    config, source, parts = prepare(episodes, folder)
    from imfvla.policy import build_policy
    from imfvla.training.data import make_loader, prepare_windows
    from imfvla.training.experiment import read_experiment

    with timed(parts, "windows"):
        windows = prepare_windows(config, source)
    with timed(parts, "statistics"):
        statistics = windows.statistics()
    with timed(parts, "policy"):
        policy = build_policy(config, statistics)
    with make_loader(read_experiment(config), windows) as batches:
        with timed(parts, "first batch"):
            next(batches)
        whole = time.time() - began
        computed = time.process_time()
        taken = []
        for number in range(BATCHES):
            first = time.perf_counter()
            batches.batch(number)
            taken.append(1e3 * (time.perf_counter() - first))
    resident, mapped = peak(), mapped_pages(folder)
    return {
        "episodes": episodes,
        "windows": len(windows),
        "parameters": sum(parameter.numel() for parameter in policy.parameters()),
        "start_s": round(whole, 2),
        "start_cpu_s": round(computed, 2),
        "parts_cpu_s": {name: round(seconds, 2) for name, seconds in parts.items()},
        "peak_mib": round(resident / MIB),
        "peak_without_store_mib": round((resident - mapped) / MIB),
        "batch_ms": round(float(np.median(taken)), 3),
    }


@contextmanager
def timed(parts: dict[str, float], name: str) -> Iterator[None]:
    """Adds the processor's time of a part, which other processes on the machine change little."""
    began = time.process_time()
    yield
    parts[name] = time.process_time() - began


def peak() -> int:
    """The most resident memory of this process [bytes]; `ru_maxrss` would count that of the process it came from."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1024 * int(re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE).group(1))


def mapped_pages(folder: Path) -> int:
    """Resident bytes of the files in a folder that this process maps."""
    found, inside = 0, False
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            inside = str(folder.resolve()) in line
        elif inside and line.startswith("Rss:"):
            found += 1024 * int(line.split()[1])
    return found


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, nargs="+", default=[200, 20_000])
    parser.add_argument(
        "--folder", type=Path, help=argparse.SUPPRESS
    )  # this and below: of the processes it starts
    parser.add_argument("--part", choices=("write", "start"), help=argparse.SUPPRESS)
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part == "write":
        write_store(options.episodes[0], options.folder)
        return 0
    if options.part == "start":
        print(json.dumps(start(options.episodes[0], options.folder, options.began)))
        return 0
    with tempfile.TemporaryDirectory(prefix="imfvla-episodes-") as folder:
        for episodes, part in product(options.episodes, ("write", "start")):
            command = [sys.executable, __file__, "--episodes", str(episodes), "--folder", folder]
            subprocess.run([*command, "--part", part, "--began", str(time.time())], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
