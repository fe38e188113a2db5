"""What the files of a run directory hold: types and limits of config, status, metrics and weights' description.

A reader turns a file into one of these once, so that nothing behind it meets anything else. Keys that are not listed
may be there too, with plain values: another version of imfvla may have written them.
"""

from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Annotated, Any, NotRequired, TypedDict

from imfvla.config.protocol import MAX_SEED
from imfvla.errors import UserError
from imfvla.options import Limit, Number, Plain, at_least, at_most, convert, one_of, within
from imfvla.storage.documents import read_json
from imfvla.storage.fitting import UNFIT, check_of

LARGEST = 1e12  # of a reward or a time: their sums and squares are finite
MAX_NAME = 200  # characters
MAX_STEPS = 10**9  # of a training
MOST_METRICS = 1000  # of a step
NAME = Limit(
    f"a text of 1 to {MAX_NAME} printable characters",
    lambda text: 0 < len(text) <= MAX_NAME and text.isprintable(),
)
FILE_NAME = Limit("the name of a file, without a directory", lambda text: PurePath(text).name == text != "..")
LABEL = Limit(
    "a text of at most 1000 printable characters", lambda text: len(text) <= 1000 and text.isprintable()
)
STATES = ("running", "done", "failed")  # of a run

Name = Annotated[str, NAME]
FileName = Annotated[str, NAME, FILE_NAME]
Label = Annotated[str, LABEL]
Seed = Annotated[int, within(0, MAX_SEED)]
Step = Annotated[int, within(0, MAX_STEPS)]
Duration = Annotated[float, within(0, LARGEST)]


class Component(TypedDict, total=False):
    """A part of a policy. What else it has is checked by `construct`."""

    _target_: Name


class Task(TypedDict, total=False):
    """The keys of a task that do not depend on its kind."""

    name: Name
    variant: Name


class RunConfig(TypedDict, total=False):
    """`config.yaml`: the keys that are read without building what they configure."""

    name: FileName  # of folders and figures
    seed: Seed
    task: Task
    training: Mapping[str, Plain]
    observation: Mapping[str, Plain]
    horizon: Mapping[str, Plain]
    evaluation: Mapping[str, Plain]
    demos: Mapping[str, Plain]
    encoder: Component
    core: Component
    generator: Component


class Status(TypedDict, total=False):
    """`status.json`."""

    state: Annotated[str, one_of(*STATES)]
    phase: Name
    pid: int


class Code(TypedDict, total=False):
    """The version of this package, as in a fingerprint."""

    version: Name
    commit: Name | None
    dirty: bool | None


class Machine(TypedDict, total=False):
    """The computer, as in a fingerprint."""

    cpu: Label


class Fingerprint(TypedDict):
    """What a result depends on besides its config."""

    code: NotRequired[Code]
    machine: Machine
    threads: NotRequired[Annotated[int, within(0, 100_000)]]
    workers: NotRequired[Annotated[int, within(0, 100_000)]]


class WeightsDescription(TypedDict):
    """`policy.json`, beside the weights."""

    step: Step
    train_s: Duration
    fingerprint: Fingerprint
    num_parameters: NotRequired[Annotated[int, at_least(1)]]
    precision: NotRequired[Label]


class MetricsRow(TypedDict):
    """A line of `metrics.jsonl`: what each line has, beside metrics as numbers."""

    step: Step
    loss: NotRequired[Number | None]


Metrics = Annotated[Mapping[str, Number | None], at_most(MOST_METRICS)]


def as_record(value: Any, hint: Any, where: str, remedy: str) -> Any:
    """`value` as the type `hint`. Raises UserError from `where`, a file or a line of it, to `remedy`."""
    if (found := check_of(hint)(value)) is not UNFIT:
        return found
    try:
        return convert(value, hint, "")
    except UserError as error:
        text = str(error).removesuffix(".")
        is_whole = text.startswith("it ")
        raise UserError(f"{where}{text[2:] if is_whole else f': {text}'}; {remedy}.") from error


def read_record(path: Path, hint: Any, remedy: str, *, home: Path | None = None) -> Any:
    """The value of a JSON file in `home` as the type `hint`. Raises UserError, ending with `remedy`, for all others."""
    return as_record(read_json(path, remedy, home=home), hint, str(path), remedy)
