"""What an offline evaluation found: the records of a run's offline.json."""

import re
from collections.abc import Mapping
from typing import Annotated, TypedDict

from imfvla.config.horizon import MAX_STEPS
from imfvla.config.protocol import MAX_EPISODES
from imfvla.errors import UserError
from imfvla.options import at_least, at_most, require, within, within_length
from imfvla.robot import MAX_CHANNELS
from imfvla.storage.records import Duration, FileName, Label, Step, read_record
from imfvla.storage.run_directory import RunDirectory

FILE = "offline.json"
HOLD, NEAREST = "hold still", "nearest demonstration"
REMEDY = "move it away and run the training again, which only evaluates"
# Steps of the chunk, then channels; None where nothing counted.
Errors = Annotated[list[Annotated[list[Duration | None], at_most(MAX_CHANNELS)]], within_length(1, MAX_STEPS)]


class Protocol(TypedDict):
    """Which weights were judged on which episodes."""

    checkpoint_step: Step
    held_out: Annotated[list[Label], at_most(MAX_EPISODES)]  # names of episodes


class Offline(TypedDict):
    """`offline.json`."""

    experiment: FileName
    protocol: Protocol
    decisions: Annotated[int, at_least(1)]
    executed: Annotated[int, within(1, MAX_STEPS)]
    channels: Annotated[list[Label], within_length(1, MAX_CHANNELS)]
    deviation: Annotated[list[Duration], at_most(MAX_CHANNELS)]
    error: Annotated[Mapping[str, Errors], at_most(100)]


def read_offline(run: RunDirectory) -> Offline | None:
    """The content of a run's offline.json, None without one. Raises UserError where it is damaged."""
    path = run.path / FILE
    if not path.exists():
        return None
    found = read_record(path, Offline, REMEDY)
    where, number = f"{path}: error", len(found["channels"])
    require(
        {HOLD, NEAREST} <= found["error"].keys(),
        where,
        f"of {HOLD}, of {NEAREST} and of policies",
        list(found["error"]),
    )
    for name, rows in found["error"].items():
        is_known = name in (HOLD, NEAREST) or bool(re.fullmatch(r"infer[1-9]\d{0,5}", name))
        require(is_known, f"{where}: a key", f"{HOLD}, {NEAREST} or infer and a number of evaluations", name)
        if len(rows) < found["executed"] or any(len(row) != number for row in rows):
            raise UserError(
                f"{where} of {name} must be a number for each step and each of {number} channels, found "
                f"{len(rows)} rows of {len(rows[0])}; {REMEDY}."
            )
    require(len(found["deviation"]) == number, f"{path}: deviation", f"{number} numbers", found["deviation"])
    return found
