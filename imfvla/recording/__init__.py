"""Episodes as MCAP files that Foxglove opens as they are, and as videos."""

from imfvla.recording.mcap_reader import (
    Episode,
    EpisodeIndex,
    episode_is_complete,
    read_episode,
    read_index,
)
from imfvla.recording.mcap_sink import McapSink

__all__ = ["Episode", "EpisodeIndex", "McapSink", "episode_is_complete", "read_episode", "read_index"]
