"""What the metadata records of an episode hold: types and limits of what an MCAP file says beside its messages."""

from collections.abc import Mapping
from typing import Annotated, NotRequired, TypedDict

from imfvla.options import Number, Plain, at_most, within
from imfvla.robot import MAX_CAMERAS

MOST_STEPS = 10**7  # control steps of an episode
MOST_DECISIONS = 1_000_000  # of an episode
Text = Annotated[str, at_most(10_000)]
Steps = Annotated[int, within(0, MOST_STEPS)]


class Style(TypedDict, total=False):
    """The hidden choices of an expert."""

    wait: Steps | None


class EpisodeMetadata(TypedDict, total=False):
    """What is known of an episode beside its parts."""

    paraphrases: Annotated[list[Text], at_most(10_000)]
    policy: Text
    nfe: int
    checkpoint_step: int
    style: Style


class InfoRecord(TypedDict):
    """`EpisodeInfo` but for its robot and its config."""

    task: Text
    kind: Text
    seed: int
    start_digest: Text
    instruction: Text
    views: Annotated[list[Text], at_most(MAX_CAMERAS)]
    metadata: NotRequired[EpisodeMetadata]


class ResultRecord(TypedDict):
    """`EpisodeResult`."""

    seed: int
    start_digest: Text
    num_steps: Steps
    total_reward: Number
    max_reward: Number
    success: bool
    first_step_of_stage: Annotated[list[Annotated[int, within(-1, MOST_STEPS)]], at_most(100)]
    failure: Text | None
    inference_ms: Annotated[list[Number], at_most(MOST_DECISIONS)]
    wall_s: Number
    goal: NotRequired[Text | None]


Config = Mapping[str, Plain]
