"""Damages files in many ways and reads them: only a UserError may be raised, within bounds of time and memory.

python tools/fuzz.py                            # 20,000 files over all readers and consumers
python tools/fuzz.py --files 200 --only mcap    # fewer, of one reader
python tools/fuzz.py --only summary --seed 17 --files 1      # reproduces a finding

The readers are those of everything that somebody else may have written: recordings, checkpoints, configs, results, and
the options of a training, which are checked before its first stage. The consumers go on with what was read: report,
compare, the start of an evaluation and of a resumed training, the tools for recordings. A file is flipped, cut, spliced
and stretched as bytes; JSON and YAML are changed as values too, and messages of a recording inside checksums that fit.
Prints a line for each and exits with 1 where anything but a UserError was raised, a file took too long, or memory grew
beyond its bound.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path

import psutil

from imfvla.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
# The files to damage are those of the tests.
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "tests"), str(ROOT / "tests" / "training")]
from fuzzing.consumers import make_consumers  # noqa: E402
from fuzzing.readers import Target, make_readers  # noqa: E402

MAX_SECONDS = 10.0  # of one file, of processor time: other work on the machine does not count
MAX_GROWTH_BYTES = 2**30  # of memory


@dataclass
class Tally:
    """The outcome of reading a reader's damaged files."""

    refused: int = 0
    read: int = 0
    slowest_s: float = 0.0
    failures: list[str] = field(default_factory=list)


class TooSlow(BaseException):
    """Raised by the clock: nothing in a reader may catch it."""


def make_targets(folder: Path) -> dict[str, Target]:
    """The readers and the consumers, each with a whole file of its own below `folder`."""
    return make_readers(folder) | make_consumers(folder / "consumers")


def fuzz(target: Target, num_files: int, first_seed: int) -> Tally:
    """Reads `num_files` damaged copies, those of the seeds from `first_seed` on; leaves the file as it was."""
    whole = target.path.read_bytes()
    tally = Tally()
    previous = signal.signal(signal.SIGPROF, _raise_too_slow)
    try:
        for seed in range(first_seed, first_seed + num_files):
            target.path.parent.mkdir(exist_ok=True)
            target.path.write_bytes(target.mutate(whole, random.Random(seed)))
            began = time.process_time()
            try:
                signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
                with redirect_stdout(StringIO()):
                    target.read(target.path)
                tally.read += 1
            except UserError:
                tally.refused += 1
            except (Exception, TooSlow):
                tally.failures.append(f"seed {seed}: {traceback.format_exc(limit=-3)}")
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
            tally.slowest_s = max(tally.slowest_s, time.process_time() - began)
    finally:
        signal.signal(signal.SIGPROF, previous)
        target.path.parent.mkdir(exist_ok=True)
        target.path.write_bytes(whole)
    return tally


def _raise_too_slow(*_: object) -> None:
    raise TooSlow(f"more than {MAX_SECONDS} s")


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--files", type=int, default=20_000, help="over all readers and consumers")
    parser.add_argument("--seed", type=int, default=0, help="of the first file of each reader")
    parser.add_argument("--only", action="append", help="only these readers")
    parser.add_argument("--summary", type=Path, help="write the figures here too, as JSON")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    failed, rows = 0, {}
    with tempfile.TemporaryDirectory(prefix="imfvla-fuzz-") as folder:
        targets = make_targets(Path(folder))
        if unknown := set(options.only or ()) - targets.keys():
            parser.error(f"no reader {', '.join(unknown)}; there are {', '.join(targets)}")
        chosen = {name: target for name, target in targets.items() if name in (options.only or targets)}
        before = psutil.Process().memory_info().rss
        limit = psutil.Process().memory_info().vms + MAX_GROWTH_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for name, target in chosen.items():
            number = -(-options.files * target.share // sum(other.share for other in chosen.values()))
            tally = fuzz(target, number, options.seed)
            failed += len(tally.failures)
            counts = {"refused": tally.refused, "read": tally.read, "failures": len(tally.failures)}
            rows[name] = counts | {"slowest_s": round(tally.slowest_s, 3)}
            print(name, *(f"{key} {value}" for key, value in rows[name].items()), sep="  ", flush=True)
            for failure in tally.failures[:3]:
                print(failure, flush=True)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    total = sum(row["refused"] + row["read"] + row["failures"] for row in rows.values())
    print(f"{total} files, {failed} failures, memory grew by at most {grown / 2**20:.0f} MiB")
    if options.summary:
        figures = {"files": total, "failures": failed, "grown_mib": round(grown / 2**20), "readers": rows}
        options.summary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 1 if failed or grown > MAX_GROWTH_BYTES else 0


if __name__ == "__main__":
    sys.exit(main())
