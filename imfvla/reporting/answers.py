"""Which evaluations answer the rows of the tables, and what to run where none does."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.reporting.mapping import Mapping
from imfvla.reporting.mapping.row import TableRow, Wanted
from imfvla.reporting.records import Row
from imfvla.reporting.runs import Evaluation, evaluations, find_runs, key_of
from imfvla.storage.run_directory import EXECUTION_KEYS, LAST, RunDirectory, differences, training_steps
from imfvla.storage.run_names import run_name

PROTOCOL = ("task", "variant", "noise_seed", "first_seed", "episodes", "max_steps", "device")


@dataclass(frozen=True, slots=True)
class Evaluated:
    """An evaluation with its episodes, in the order of their seeds."""

    evaluation: Evaluation
    episodes: tuple[Row, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """What fills a row of the tables: an evaluation for each training seed, ascending; none where it is missing."""

    row: TableRow
    evaluated: tuple[Evaluated, ...]
    command: str  # that fills the row where it is missing

    @property
    def is_missing(self) -> bool:
        return not self.evaluated


class Sources:
    """The runs below some directories. A row is filled from the last directory that has an evaluation for it."""

    def __init__(self, directories: Sequence[Path]) -> None:
        runs = [find_runs([Path(directory)]) for directory in directories]
        self.configs = {run.path: run.config() for of_directory in runs for run in of_directory}
        self.evaluations = [
            [
                found
                for run in of_directory
                for found in evaluations(run, self.configs[run.path])
                if found.is_reporting
            ]
            for of_directory in runs
        ]

    def answer(self, row: TableRow, mapping: Mapping) -> Answer:
        """The evaluations of a row.

        Raises UserError naming the row where runs contradict each other or were evaluated with another protocol than
        the row's, and naming file and line where episodes are damaged.
        """
        others: list[Evaluation] = []
        for found in reversed(self.evaluations):
            candidates = [evaluation for evaluation in found if _is_of(evaluation, row)]
            wanted = [evaluation for evaluation in candidates if _as_wanted(evaluation, row.wanted) is None]
            others += [evaluation for evaluation in candidates if evaluation not in wanted]
            if wanted:
                wanted.sort(key=lambda evaluation: evaluation.training_seed)
                _check_seeds(row, wanted)
                return Answer(row, tuple(read_evaluated(evaluation) for evaluation in wanted), "")
        command = self.command(row, mapping)
        if others:
            raise UserError(
                f"{row.where} ({row.name}) needs another protocol than that of {others[0].folder}, where "
                f"{_as_wanted(others[0], row.wanted)}. Run: {command}"
            )
        return Answer(row, (), command)

    def command(self, row: TableRow, mapping: Mapping) -> str:
        """What to run so that the row is filled."""
        directory = f"runs/{row.experiment}/{run_name(row.overrides)}"
        for path, config in reversed(self.configs.items()):
            if _has_weights(path, config, row):
                return _evaluate(row, path)
        last = {
            other.nfe
            for other in mapping.rows
            if (other.experiment, other.checkpoint) == (row.experiment, LAST)
            and other.run == row.run
            and not other.changes
        }
        overrides = "".join(f" {override}" for override in row.overrides)
        counts = ",".join(map(str, sorted(last or {row.nfe})))
        train = f"python -m imfvla.train +exp={row.experiment}{overrides} 'evaluation.nfe=[{counts}]'"
        is_usual = row.checkpoint == LAST and not row.changes
        return train if is_usual else f"{train} && {_evaluate(row, Path(directory))}"

    def others(self, answers: Sequence[Answer]) -> list[list[Evaluated]]:
        """Evaluations of the reporting band that fill no row; those of all training seeds together.

        Where several directories have a policy, the last one counts.
        """
        taken = {found.evaluation.folder for answer in answers for found in answer.evaluated}
        answered = {_identity(found.evaluation) for answer in answers for found in answer.evaluated}
        chosen: dict[tuple, Evaluation] = {}
        for found in self.evaluations:
            for evaluation in found:
                identity = _identity(evaluation)
                if evaluation.folder not in taken and identity not in answered:
                    chosen[identity] = evaluation
        groups = groupby(sorted(chosen), key=lambda identity: identity[:-1])
        of_seeds = [[chosen[identity] for identity in identities] for _, identities in groups]
        for found in of_seeds:
            refuse_copies(found)
        return [[read_evaluated(evaluation) for evaluation in found] for found in of_seeds]


def check_equal_protocols(answers: Sequence[Answer], task: str) -> None:
    """Raises UserError where rows of one table were evaluated with different protocols, or another task than its."""
    every = [(answer.row, found) for answer in answers for found in answer.evaluated]
    for row, one in every:
        if (played := one.evaluation.summary["protocol"].get("task")) != task:
            raise UserError(
                f"{row.table} is of the task {task}, but {one.evaluation.folder} ({row.where}) played {played}: put "
                "the row into a table of that task."
            )
    for (row, one), (other_row, other) in pairwise(every):
        ours, theirs = one.evaluation.summary["protocol"], other.evaluation.summary["protocol"]
        for key in PROTOCOL:
            if ours.get(key) != theirs.get(key):
                raise UserError(
                    f"{row.table} mixes protocols: {key} is {ours.get(key)!r} in {one.evaluation.folder} "
                    f"({row.where}) and {theirs.get(key)!r} in {other.evaluation.folder} ({other_row.where}); "
                    "evaluate both with the same protocol."
                )


def _is_of(evaluation: Evaluation, row: TableRow) -> bool:
    """Whether it is of the row's policy, weights and NFE, with its noise, clock and condition."""
    if (evaluation.experiment, evaluation.nfe) != (row.experiment, row.nfe):  # first what is found at once
        return False
    if evaluation.key != row.run or evaluation.changes != dict(row.changes):
        return False
    return evaluation.summary["checkpoint_step"] == row.step(evaluation.training_steps)


def _as_wanted(evaluation: Evaluation, wanted: Wanted) -> str | None:
    """What differs from the wanted evaluation; None if nothing does."""
    protocol = evaluation.summary["protocol"]
    for key in Wanted.__slots__:
        if protocol.get(key) != getattr(wanted, key):
            return f"{key} is {protocol.get(key)!r}, not {getattr(wanted, key)!r}"
    return None


def _check_seeds(row: TableRow, found: Sequence[Evaluation]) -> None:
    """Several evaluations may fill a row if their policies differ only in the training seed."""
    for one, other in pairwise(found):
        if one.training_seed == other.training_seed:
            raise UserError(
                f"{row.where} ({row.name}) is answered twice, by {one.folder} and {other.folder}: move one "
                "elsewhere, or set directories=[...] to directories that hold only one of them."
            )
        differing = differences(one.config, other.config, ("seed", *EXECUTION_KEYS))
        if differing:
            raise UserError(
                f"{row.where} ({row.name}) is answered by runs of different configs, {one.run} and {other.run}: "
                f"{'; '.join(differing)}. Move one elsewhere."
            )
    refuse_copies(found)


def read_evaluated(evaluation: Evaluation) -> Evaluated:
    """An evaluation with its episodes."""
    return Evaluated(evaluation, evaluation.episodes)


def refuse_copies(found: Sequence[Evaluation]) -> None:
    """Raises UserError where evaluations of several training seeds are of the same weights, of a copied run."""
    seen: dict[str, Evaluation] = {}
    for evaluation in found:
        weights = evaluation.summary["protocol"].get("weights")
        if weights in seen:
            raise UserError(
                f"{seen[weights].run} and {evaluation.run} have the same weights ({weights}), so that seeds "
                f"{seen[weights].training_seed} and {evaluation.training_seed} are one training: move the copy "
                "elsewhere."
            )
        if weights is not None:
            seen[weights] = evaluation


def _has_weights(run: Path, config: dict[str, Any], row: TableRow) -> bool:
    if config.get("name") != row.experiment or key_of(run, row.experiment) != row.run:
        return False
    return row.step(training_steps(config, run)) in RunDirectory(run).weight_steps()


def _evaluate(row: TableRow, run: Path) -> str:
    wanted = row.wanted
    parts = [f"python -m imfvla.evaluate {shlex.quote(f'run={run}')} nfe={row.nfe}"]
    if row.checkpoint != LAST:
        parts.append(f"checkpoint={row.checkpoint}")
    parts.append(f"first_seed={wanted.first_seed} episodes={wanted.episodes}")
    if wanted.noise_seed:
        parts.append(f"noise_seed={wanted.noise_seed}")
    if wanted.device != "cpu":
        parts.append(f"device={wanted.device}")
    return " ".join([*parts, *row.options()])


def _identity(evaluation: Evaluation) -> tuple:
    summary = evaluation.summary
    return (
        summary["protocol"]["task"],
        evaluation.label,
        evaluation.nfe,
        summary["checkpoint_step"] == evaluation.training_steps,
        summary["seeds"][0],
        summary["episodes"],
        evaluation.training_seed,
    )
