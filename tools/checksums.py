"""What the checksums of frame stores cost: processor time, which other processes on the machine change little.

python tools/checksums.py                     # decoding demonstrations into a store, with and without checksums
python tools/checksums.py data/demos/..._frames_96x96   # checking a store, as every training does when it starts

Demonstrations are recorded without a simulator, at the size and number of views that experiments use. Prints one line
of JSON. Neither a step of training nor a recording runs any of this code.
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

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests")]
from synthetic import VIEWS, write_demonstrations  # noqa: E402

from imfvla.data import FrameStore, checksums  # noqa: E402
from imfvla.data.frame_store import ARRAYS, IMAGES  # noqa: E402
from imfvla.sources.mcap import McapSource  # noqa: E402

SIZE, EPISODES, STEPS, REPEATS = (96, 96), 8, 200, 3


def building(folder: Path) -> dict[str, float]:
    """Seconds to decode some demonstrations, the median of a few times, with and without checksums."""
    write_demonstrations(folder / "demos", num_episodes=EPISODES, num_steps=STEPS, image_size=SIZE)
    source = McapSource.of(folder / "demos")
    taken: dict[str, list[float]] = {"with": [], "without": []}
    for number in range(REPEATS):
        for kind in taken:
            with mock.patch.object(
                checksums, "block_sums", checksums.block_sums if kind == "with" else no_sums
            ):
                path = folder / f"store-{number}-{kind}"
                taken[kind].append(seconds(lambda path=path: FrameStore.build(source, path, SIZE, VIEWS)))
    medians = {kind: float(np.median(values)) for kind, values in taken.items()}
    size = (folder / "store-0-with" / IMAGES).stat().st_size
    return {
        "store_gb": round(size / 1e9, 3),
        "build_s": round(medians["with"], 2),
        "build_without_s": round(medians["without"], 2),
        "slower": round(medians["with"] / medians["without"] - 1, 4),
    }


def checking(store: Path) -> dict[str, float]:
    """Seconds to read a store and compare it, the median of a few times."""
    size = sum((store / name).stat().st_size for name in ARRAYS)
    taken = [seconds(lambda: [checksums.block_sums(store / name) for name in ARRAYS]) for _ in range(REPEATS)]
    middle = float(np.median(taken))
    return {
        "store_gb": round(size / 1e9, 3),
        "check_s": round(middle, 2),
        "s_per_gb": round(1e9 * middle / size, 2),
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
    parser.add_argument("store", nargs="?", type=Path, help="a frame store; by default one is made")
    store = parser.parse_args().store
    if store is not None:
        print(json.dumps(checking(store)))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(building(Path(folder))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
