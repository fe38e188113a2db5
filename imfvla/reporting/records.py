"""What the files of an evaluation hold: the types and limits of `summary.json` and of the lines of `episodes.jsonl`.

Keys that are not listed may be there too, with plain values: another version of imfvla may have written them.
"""

from pathlib import PurePath
from typing import Annotated, NotRequired, TypedDict

from imfvla.options import Limit, above, at_most, within
from imfvla.protocol import MAX_EPISODES, MAX_SEED

MOST_STEPS = 10**7  # control steps of an episode
MOST_STAGES = 1000
MOST_DECISIONS = 100_000  # of an episode
LARGEST = 1e12  # of a reward or a time: their sums and squares are finite
MAX_NAME = 200  # characters
NAME = Limit(
    f"a text of 1 to {MAX_NAME} printable characters",
    lambda text: len(text) <= MAX_NAME and text.isprintable() and bool(text),
)
FILE_NAME = Limit("the name of a file, without a directory", lambda text: PurePath(text).name == text != "..")

Name = Annotated[str, NAME]
FileName = Annotated[str, NAME, FILE_NAME]
Seed = Annotated[int, within(0, MAX_SEED)]
Count = Annotated[int, within(0, MAX_EPISODES)]
Amount = Annotated[float, within(-LARGEST, LARGEST)]
Duration = Annotated[float, within(0, LARGEST)]
Positive = Annotated[float, above(0), within(0, LARGEST)]
Share = Annotated[float, within(0, 1)]
Step = Annotated[int, within(1, 10**9)]  # of a training


class Timing(TypedDict):
    """All that differs between equal runs."""

    wall_s: Duration
    inference_ms: Annotated[list[Positive], at_most(MOST_DECISIONS)]  # one per replanning


class Row(TypedDict):
    """One line of `episodes.jsonl`."""

    seed: Seed
    start_digest: Name
    num_steps: Annotated[int, within(0, MOST_STEPS)]
    total_reward: Amount
    max_reward: Amount
    success: bool
    first_step_of_stage: Annotated[list[Annotated[int, within(-1, MOST_STEPS)]], at_most(MOST_STAGES)]
    failure: Name | None
    goal: NotRequired[Name]
    timing: Timing
