"""What the files of an evaluation hold: types and limits of `summary.json` and of the lines of `episodes.jsonl`.

Keys that are not listed may be there too, with plain values: another version of imfvla may have written them.
"""

from collections.abc import Mapping
from typing import Annotated, NotRequired, TypedDict

from imfvla.config.condition import SEVERITIES
from imfvla.config.protocol import (
    CLOCKS,
    DELAY,
    MAX_EPISODES,
    MEANWHILE,
    MOST_BATCH,
    MOST_CANDIDATES,
    NOISES,
    PREFIXES,
    RUNTIMES,
)
from imfvla.options import above, at_most, of_length, one_of, within
from imfvla.storage.records import LARGEST, Duration, FileName, Fingerprint, Label, Machine, Name, Seed, Step

MOST_STEPS = 10**7  # control steps of an episode
MOST_STAGES = 100
MOST_DECISIONS = 100_000  # of an episode
MOST_NFE = 10**6

Count = Annotated[int, within(0, MAX_EPISODES)]
Nfe = Annotated[int, within(1, MOST_NFE)]
Amount = Annotated[float, within(-LARGEST, LARGEST)]
Positive = Annotated[float, above(0), within(0, LARGEST)]
Share = Annotated[float, within(0, 1)]


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
    chunk_jump: NotRequired[Annotated[float, within(0, LARGEST)]]
    condition_happened: NotRequired[bool]
    timing: Timing


# One of its keys is a keyword of Python.
Recording = TypedDict("Recording", {"seed": Seed, "return": Amount, "file": FileName})


class ProtocolRecord(TypedDict):
    """What the rows of an evaluation depend on, besides the code."""

    task: Name
    variant: Name
    noise_scale: Share
    # What differs from these in a comparison is named; older evaluations lack some.
    checkpoint_step: NotRequired[Step]
    weights: NotRequired[Name]
    nfe: NotRequired[Nfe]
    noise_seed: NotRequired[Seed]
    first_seed: NotRequired[Seed]
    episodes: NotRequired[Count]
    max_steps: NotRequired[Annotated[int, within(1, MOST_STEPS)] | None]
    device: NotRequired[Name]
    # As `config.protocol.USUAL` where it is older than them.
    clock: NotRequired[Annotated[str, one_of(*CLOCKS)]]
    delay_ms: NotRequired[Annotated[int | float | str, DELAY]]
    delay_steps: NotRequired[Annotated[int, within(0, MOST_STEPS)]]
    meanwhile: NotRequired[Annotated[str, one_of(*MEANWHILE)]]
    prefix: NotRequired[Annotated[str, one_of(*PREFIXES)]]
    noise: NotRequired[Annotated[str, one_of(*NOISES)]]
    candidates: NotRequired[Annotated[int, within(1, MOST_CANDIDATES)]]
    condition: NotRequired[Name]
    severity: NotRequired[Annotated[int, within(SEVERITIES[0], SEVERITIES[-1])] | None]
    runtime: NotRequired[Annotated[str, one_of(*RUNTIMES)]]
    batch: NotRequired[Annotated[int, within(1, MOST_BATCH)]]


class Latency(TypedDict):
    """The time of a chunk, taken alone: see `rollouts.latency`."""

    weights: NotRequired[Name]
    nfe: NotRequired[Nfe]
    candidates: NotRequired[Annotated[int, within(1, MOST_CANDIDATES)]]
    prefix: NotRequired[Annotated[str, one_of(*PREFIXES)]]
    device: NotRequired[Name]
    runtime: NotRequired[Annotated[str, one_of(*RUNTIMES)]]  # eager where it is older
    machine: NotRequired[Machine]
    median_ms: Positive
    p95_ms: Positive
    calls: Count
    at: Name
    load: Duration  # mean number of waiting processes in the minute before


MOST_LATENCIES = 1000
Latencies = Annotated[list[Latency], at_most(MOST_LATENCIES)]  # latency.json


class Summary(TypedDict):
    """`summary.json`."""

    # A copy of what its episodes say, whose numbers take their place: `recomputed`.
    episodes: NotRequired[Annotated[int, within(1, MAX_EPISODES)]]
    avg_return: NotRequired[Amount]
    median_return: NotRequired[Amount]
    mean_max_reward: NotRequired[Amount]
    max_return: NotRequired[Amount]
    nonzero_episodes: NotRequired[Count]
    success_episodes: NotRequired[Count]
    inference_fps: NotRequired[Positive | None]
    control_fps: NotRequired[Duration | None]
    inference_ms_mean: NotRequired[Positive | None]
    inference_ms_median: NotRequired[Positive | None]
    inference_ms_p95: NotRequired[Positive | None]
    success_interval: NotRequired[Annotated[list[Share], of_length(2)]]
    success_of_goal: NotRequired[Mapping[str, Annotated[list[Count], of_length(2)]]]
    condition_happened: NotRequired[Annotated[list[Count], of_length(2)]]
    failures: NotRequired[Annotated[Mapping[str, Count], at_most(1000)]]
    name: FileName
    experiment: FileName
    nfe: Nfe
    checkpoint_step: Step
    stages: NotRequired[Annotated[list[Label], at_most(MOST_STAGES)]]
    seeds: Annotated[list[Seed], of_length(2)]
    protocol: ProtocolRecord
    latency_alone: NotRequired[Latency]  # what a measured delay is
    recordings: NotRequired[Annotated[Mapping[str, Recording], at_most(100)]]
    fingerprint: Fingerprint
