"""What the checksums of frame stores cost: processor time, which other processes on the machine change little.

python tools/checksums.py data/demos/FOLDER

Decodes the first recordings of a folder into a store, with and without checksums, and checks the store, as every
training does when it starts. Prints one line of JSON. Neither a step of training nor a recording runs any of this code.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

from imfvla.data import FrameStore, checksums
from imfvla.data.store_format import ARRAYS
from imfvla.recording import Recordings
from imfvla.sources.mcap import McapSource

EPISODES, REPEATS = 8, 3


def measure(recordings: Path, scratch: Path) -> dict[str, float]:
    """Seconds, each the median of a few times."""
    names = [path.name for path in Recordings.of(recordings).files[:EPISODES]]
    source = McapSource(Recordings.named(recordings, names, "measured"))
    camera = source.robot.cameras[0]
    views, size = tuple(camera.name for camera in source.robot.cameras), (camera.height, camera.width)
    taken: dict[str, list[float]] = {"build_s": [], "build_without_s": [], "check_s": []}
    for number in range(REPEATS):
        for name in ("build_s", "build_without_s"):
            store = scratch / f"{number}-{name}"
            with mock.patch.object(
                checksums, "block_sums", checksums.block_sums if name == "build_s" else no_sums
            ):
                taken[name].append(seconds(lambda path=store: FrameStore.build(source, path, size, views)))
        store = scratch / f"{number}-build_s"
        taken["check_s"].append(
            seconds(lambda path=store: [checksums.block_sums(path / name) for name in ARRAYS])
        )
    num_bytes = sum((store / name).stat().st_size for name in ARRAYS)
    medians = {name: float(np.median(values)) for name, values in taken.items()}
    return {
        "episodes": len(names),
        "store_mb": round(num_bytes / 1e6, 1),
        **{name: round(value, 3) for name, value in medians.items()},
        "build_slower": round(medians["build_s"] / medians["build_without_s"] - 1, 4),
        "check_s_per_gb": round(1e9 * medians["check_s"] / num_bytes, 2),
    }


def seconds(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def no_sums(path: Path) -> list[str]:
    return []


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", type=Path, help="a folder of demonstrations")
    with tempfile.TemporaryDirectory() as scratch:
        print(json.dumps(measure(parser.parse_args().recordings, Path(scratch))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
