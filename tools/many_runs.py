"""What `make tables` takes over many long evaluations: processor time and peak memory (Linux).

python tools/many_runs.py                              # 100 runs of 1,000 episodes
python tools/many_runs.py --runs 20 --episodes 200

Makes run directories from the committed ones, whose episodes are repeated under other seeds until there are enough, and
whose trainings are repeated under other seeds until those are. Then a fresh process makes tables, figures and page.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from itertools import count, islice
from pathlib import Path
from typing import Any

import yaml

from imfvla.config.protocol import REPORTING_FIRST_SEED
from imfvla.errors import UserError
from imfvla.reporting.recomputed import DIGEST, EPISODES, digest_of

COMMITTED = Path("experiments/pretrained"), Path("experiments/results")
MAPPING = Path("experiments/tables.yaml")
# Of a summary: what is said of evaluation and machine. Numbers are computed from the episodes.
KEPT = ("experiment", "nfe", "checkpoint_step", "stages", "protocol", "latency_alone", "fingerprint")
MIB = 2**20


def copies(found: Sequence[Path]) -> Iterator[tuple[Path, int | None]]:
    """Run directories with the training seed of their copy, None for their own, endlessly."""
    yield from ((run, None) for run in found)
    seedless = [run for run in found if "seed=" not in run.name]
    for seed in count(100):
        yield from ((run, seed) for run in seedless)


def write_run(run: Path, home: Path, seed: int | None, episodes: int) -> None:
    """Copies a run directory with so many episodes in each of its evaluations."""
    name = run.name if seed is None else f"seed={seed}" + f",{run.name}".removesuffix(",default")
    copy = home / run.parent.name / name
    copy.mkdir(parents=True)
    for kept in ("metrics.jsonl", "status.json"):
        if (run / kept).exists():
            shutil.copy(run / kept, copy / kept)
    config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    config["seed"] = config["seed"] if seed is None else seed
    (copy / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    for summary in sorted(run.glob("rollouts/*/summary.json")):
        write_evaluation(summary, copy / "rollouts", seed, episodes)


def write_evaluation(summary: Path, rollouts: Path, seed: int | None, episodes: int) -> None:
    said = json.loads(summary.read_text(encoding="utf-8"))
    rows = [json.loads(line) for line in (summary.parent / EPISODES).read_text(encoding="utf-8").splitlines()]
    seeds = range(REPORTING_FIRST_SEED, REPORTING_FIRST_SEED + episodes)
    text = "".join(
        json.dumps(rows[place % len(rows)] | {"seed": one, "start_digest": f"{one:016x}"}) + "\n"
        for place, one in enumerate(seeds)
    )
    name = re.sub(r"seeds\d+-\d+", f"seeds{seeds[0]}-{seeds[-1]}", summary.parent.name)
    protocol = said["protocol"] | {"first_seed": seeds[0], "episodes": episodes}
    if seed is not None:
        protocol["weights"] = digest_of(f"{protocol['weights']} of seed {seed}")
    folder = rollouts / name
    folder.mkdir(parents=True)
    (folder / EPISODES).write_text(text, encoding="utf-8")
    kept: dict[str, Any] = {key: said[key] for key in KEPT if key in said}
    if latency := kept.get("latency_alone"):  # of the same weights
        kept["latency_alone"] = latency | {key: protocol[key] for key in ("weights",) if key in latency}
    kept |= {"name": name, "seeds": [seeds[0], seeds[-1]], "protocol": protocol, DIGEST: digest_of(text)}
    (folder / "summary.json").write_text(json.dumps(kept), encoding="utf-8")


@as_command
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--profile", type=Path, help="file for a cProfile of the process")
    options = parser.parse_args(arguments)
    paths = [path.parent for home in COMMITTED for path in sorted(home.glob("*/*/config.yaml"))]
    found = list(
        {path.parts[-2:]: path for path in paths}.values()
    )  # the last of two of one name, as in a report
    if not found:
        raise UserError("No committed run directories found: start from the repository's root.")
    with tempfile.TemporaryDirectory() as scratch:
        runs, evaluations = Path(scratch) / "runs", 0
        for run, seed in islice(copies(found), options.runs):
            write_run(run, runs, seed, options.episodes)
        evaluations = len(list(runs.glob("*/*/rollouts/*")))
        profiled = ["-m", "cProfile", "-o", str(options.profile)] if options.profile else []
        mapping = Path(scratch) / "tables.yaml"
        text = re.sub(
            r"\bepisodes: \d+", f"episodes: {options.episodes}", MAPPING.read_text(encoding="utf-8")
        )
        mapping.write_text(text, encoding="utf-8")
        command = [sys.executable, *profiled, "-m", "imfvla.report", f"directories=[{runs}]"]
        command += [f"mapping={mapping}", f"output={scratch}/tables"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(
        f"{options.runs} runs, {evaluations} evaluations of {options.episodes} episodes: "
        f"{used.ru_utime + used.ru_stime:.1f} s of processor time, {used.ru_maxrss * 1024 / MIB:.0f} MiB at most"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
