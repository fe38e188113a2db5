"""Reads run directories: the evaluations of a run, one for each NFE."""

import os
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imfvla.config.protocol import MAX_EPISODES, REPORTING_SEEDS, USUAL, as_recorded, unusual
from imfvla.errors import UserError
from imfvla.options import require
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.recomputed import DESCRIPTION, description_digest, recomputed
from imfvla.reporting.records import Row, Summary
from imfvla.storage.documents import read_json
from imfvla.storage.opening import walk
from imfvla.storage.records import as_record
from imfvla.storage.run_directory import RunDirectory, training_steps
from imfvla.storage.run_names import run_key
from imfvla.storage.trained_config import DIGEST, refuse_changed_config, refuse_other_config

REMEDY = "evaluate again with overwrite=true"


@dataclass(frozen=True, slots=True)
class Evaluation:
    """One finished evaluation of a run, every number of it from its episodes."""

    run: Path
    folder: Path
    summary: Summary  # `summary.json`, every metric in it, its protocol completed
    config: dict[str, Any]  # `config.yaml` of the run
    episodes: tuple[Row, ...]  # in the order of their seeds

    @property
    def experiment(self) -> str:
        return self.summary["experiment"]

    @property
    def nfe(self) -> int:
        return self.summary["nfe"]

    @property
    def noise_scale(self) -> float:
        return self.summary["protocol"]["noise_scale"]

    @property
    def is_usual(self) -> bool:
        """Whether noise, clock and world were as in all rows of the tables."""
        return not self.changes

    @property
    def changes(self) -> dict[str, Any]:
        """What was not, as keys and values of the protocol."""
        protocol = self.summary["protocol"]
        asked = (key for key in USUAL if key != "delay_steps")  # which follows from the others
        return {key: protocol[key] for key in asked if protocol[key] != USUAL[key]}

    @property
    def unusual(self) -> tuple[str, ...]:
        """What was not, in words."""
        return unusual(self.summary["protocol"])

    @property
    def key(self) -> str:
        """The overrides in the name of the run directory, without its training seed; "" for none."""
        return key_of(self.run, self.experiment)

    @property
    def policy(self) -> str:
        """What was trained, without the seed."""
        return f"{self.experiment}/{self.key}" if self.key else self.experiment

    @property
    def label(self) -> str:
        return ", ".join((self.policy, *self.unusual))

    @property
    def training_seed(self) -> int:
        return self.config.get("seed", 0)

    @property
    def training_steps(self) -> int:
        """Of the whole training. Raises UserError where the config does not say them."""
        return training_steps(self.config, self.run)

    @property
    def seeds(self) -> range:
        """Of the episodes."""
        first, last = self.summary["seeds"]
        return range(first, last + 1)

    @property
    def row(self) -> TableRow | None:
        """The row of the tables with the same policy and NFE, whatever the checkpoint."""
        return read_mapping().find(self.experiment, self.key, self.nfe) if self.is_usual else None

    @property
    def is_reporting(self) -> bool:
        """Whether whole episodes were rolled out from seeds of the reporting band."""
        whole = self.summary["protocol"].get("max_steps") is None
        return whole and all(seed in REPORTING_SEEDS for seed in self.summary["seeds"])


def key_of(run: Path, experiment: str) -> str:
    """The overrides in the name of a run directory, as in `Evaluation.key`."""
    name = run.resolve().name
    return "" if name == experiment else run_key(name)


def evaluations(
    run: RunDirectory, config: dict[str, Any] | None = None, protocol: Mapping[str, Any] | None = None
) -> list[Evaluation]:
    """All finished evaluations of a run, by folder name; one that is being replaced counts as unfinished.

    Raises UserError for broken summaries and episodes, and where config.yaml is not what was trained and evaluated.

    Args:
      config: the run's, to avoid reading it again.
      protocol: what the protocol of an evaluation must say; the episodes of others are not read.
    """
    config = run.config() if config is None else config
    folders = sorted(path.parent for path in run.path.glob("rollouts/*/summary.json"))
    found = (_read_whole(run, folder, config, protocol or {}) for folder in folders)
    return [evaluation for evaluation in found if evaluation is not None]


def rows(run: RunDirectory) -> list[Evaluation]:
    """The evaluations that represent a run, one for each NFE, ascending.

    Of several: whole episodes of the reporting band before others, then the usual noise, then later weights, then more
    episodes.

    Raises:
      UserError: the directory holds no run, no finished evaluation, or a broken summary.
    """
    found = evaluations(run)
    if not found:
        raise UserError(
            f"{run.path} has no finished evaluation: make one with python -m imfvla.evaluate "
            f"{shlex.quote(f'run={run.path}')}."
        )
    chosen: dict[int, Evaluation] = {}
    for evaluation in sorted(found, key=_rank):
        chosen[evaluation.nfe] = evaluation
    return [chosen[nfe] for nfe in sorted(chosen)]


def find_runs(directories: Iterable[Path]) -> list[RunDirectory]:
    """Runs in or below the directories, finished or not, in their order and by path within each."""
    found: dict[Path, None] = {}
    for root in directories:
        # `Path.glob` fails where a training deletes a folder meanwhile.
        found |= dict.fromkeys(
            sorted(Path(place) for place, _, names in walk(root) if "config.yaml" in names)
        )
    return [RunDirectory(path) for path in found]


def _rank(evaluation: Evaluation) -> tuple[bool, bool, int, int]:
    summary = evaluation.summary
    return evaluation.is_reporting, evaluation.is_usual, summary["checkpoint_step"], summary["episodes"]


def _read_whole(
    run: RunDirectory, folder: Path, config: dict[str, Any], protocol: Mapping[str, Any]
) -> Evaluation | None:
    """An evaluation as one command wrote it, None while another one replaces it, or where its protocol differs."""
    while (before := _version(folder)) is not None:
        try:
            return _read(run, folder, config, protocol)
        except UserError:
            if _version(folder) == before:
                raise
    return None


def _version(folder: Path) -> tuple[int, int] | None:
    """Tells summaries apart that took each other's place; None where there is none."""
    try:
        found = os.lstat(folder / "summary.json")
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def _read(
    run: RunDirectory, folder: Path, config: dict[str, Any], protocol: Mapping[str, Any]
) -> Evaluation | None:
    path = folder / "summary.json"
    summary = read_summary(path, run.path)
    if not protocol.items() <= summary["protocol"].items():
        return None
    refuse_changed_config(run, config, summary["checkpoint_step"])
    refuse_other_config(config, run.path, path, summary.get(DIGEST))
    summary, episodes = recomputed(folder, summary, home=run.path)
    return Evaluation(run.path, folder, summary, config, episodes)


def read_summary(path: Path, home: Path | None = None) -> Summary:
    """What a summary in the run `home` says, its protocol completed. Raises UserError for anything else."""
    found = read_json(path, REMEDY, mapping=True, home=home)
    stated = found.get(DESCRIPTION)
    if stated is not None and stated != description_digest(found):
        raise UserError(
            f"{path} was changed after it was written: it is not what its {DESCRIPTION} was made of; {REMEDY}."
        )
    found.setdefault("name", path.parent.name)
    if isinstance(protocol := found.get("protocol"), dict):
        found |= {"protocol": as_recorded(protocol)}
    summary = as_record(found, Summary, str(path), REMEDY)
    first, last = summary["seeds"]
    wanted = f"[first, last] of at most {MAX_EPISODES} episodes"
    require(0 <= last - first < MAX_EPISODES, f"{path}: seeds", wanted, summary["seeds"])
    return summary
