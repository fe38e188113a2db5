"""A file system that another process serves: SIGKILL of work on it, and stores that are replaced while in use."""

import random
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

from faults.killing import kills_of
from faults.outcome import Differs, demonstrations_of, rows_of, state_of
from faults.sharing import stores_replaced
from faults.work import collect, roll_out, train

COMMAND = (
    "bindfs"  # shows one folder at another place; it keeps an open file that is deleted as .fuse_hidden...
)


def fuse(folder: Path, kills: int, rng: random.Random) -> str:
    """The same as on a local disk, a fifth as often, on a FUSE mount."""
    if shutil.which(COMMAND) is None:
        raise Differs(f"{COMMAND} is not installed: on Debian apt-get install bindfs fuse3")
    kills = max(2, kills // 5)
    works = {
        "training": kills_of(partial(train, steps=10 * kills), state_of, 10 * kills),
        "collection": kills_of(partial(collect, episodes=4 * kills), demonstrations_of, 4 * kills),
        "evaluation": kills_of(partial(roll_out, episodes=8 * kills), rows_of, 8 * kills),
    }
    said = []
    with mounted(folder / "served", folder / "mount") as place:
        for name, work in works.items():
            (place / name).mkdir()
            said.append(f"{name}: {work(place / name, kills, rng)}")
        (place / "stores").mkdir()
        said.append(stores_replaced(place / "stores", kills, nullcontext))
    return "; ".join(said)


@contextmanager
def mounted(served: Path, place: Path) -> Iterator[Path]:
    """Mounts a folder at another place."""
    served.mkdir()
    place.mkdir()
    done = subprocess.run([COMMAND, str(served), str(place)], capture_output=True, check=False)
    if done.returncode:
        raise Differs(f"no right to mount: {done.stderr.decode().strip()}")
    try:
        yield place
    finally:
        subprocess.run(["fusermount3", "-u", "-z", str(place)], check=False)
