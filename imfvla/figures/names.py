"""The names of trained policies in figures: the method of the tables' row, and what was changed in it."""

import re
from functools import cache

from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.results import Result
from imfvla.reporting.runs import Evaluation

USUAL = "as in the tables"
CHANGES = {"task.expert.modes=1": "unimodal demonstrations", "noise 0": "chunks from no noise"}
# of a row's setting, what is no part of a policy: the NFE, and the paper's own steps of training
NOT_TRAINED = re.compile(r"infer\d+|\d+k|step\d+")


def training_of(evaluation: Evaluation) -> tuple[str, list[str]]:
    """Method of a policy and what was changed in it, such as ("L1 regression", ["unimodal demonstrations"])."""
    found = _nearest(evaluation.experiment, evaluation.key)
    if found is None:
        return evaluation.experiment, _split(evaluation.key)
    changes = [text for text in _split(evaluation.key) if text not in found.overrides]
    return _trained(found), [CHANGES.get(text, text) for text in changes]


def policy_of(evaluation: Evaluation) -> tuple[str, str]:
    """As `training_of`, with what was unusual in the evaluation among the changes; USUAL where there are none."""
    name, changes = training_of(evaluation)
    changes += [CHANGES.get(text, text) for text in evaluation.unusual]
    return name, ", ".join(changes) or USUAL


def result_name(result: Result) -> str:
    """The policy of a result; of a row of the tables the method that the table names, with its weights' share."""
    evaluation = result.first
    name, change = policy_of(evaluation)
    if result.row and not _is_shared(result.row):
        name = result.row.method
    if change != USUAL:
        name = f"{name}, {change}"
    return name if result.is_last else f"{name}, weights of step {evaluation.summary['checkpoint_step']}"


def _split(key: str) -> list[str]:
    """Overrides in the name of a run directory; a comma within one is followed by no `key=`."""
    return re.split(r",(?=[^,=]+=)", key) if key else []


@cache
def _nearest(experiment: str, key: str) -> TableRow | None:
    """The first row of an experiment whose overrides are all among those of a run; of several that with most."""
    given = set(_split(key))
    rows = [
        row for row in read_mapping().rows if row.experiment == experiment and given >= set(row.overrides)
    ]
    return max(rows, key=lambda row: len(row.overrides), default=None)


def _is_shared(row: TableRow) -> bool:
    """Whether several trainings of a table share the method's name."""
    rows = [other for other in read_mapping().of_table(row.table) if other.method == row.method]
    return len({(other.experiment, other.overrides) for other in rows}) > 1


def _trained(row: TableRow) -> str:
    """A name of the training that answers a row, unique in its table."""
    if not _is_shared(row):
        return row.method
    parts = [part for part in row.setting.split(", ") if not NOT_TRAINED.fullmatch(part)]
    return f"{row.method}, {', '.join(parts)}"
