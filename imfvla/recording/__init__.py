"""Episodes as MCAP files that Foxglove opens as they are, and as videos."""

from imfvla.recording.mcap_reader import (
    Episode,
    EpisodeIndex,
    episode_is_complete,
    read_episode,
    read_index,
)
from imfvla.recording.mcap_sink import McapSink
from imfvla.recording.video import VideoSink, write_mp4

__all__ = [
    "Episode",
    "EpisodeIndex",
    "McapSink",
    "VideoSink",
    "episode_is_complete",
    "read_episode",
    "read_index",
    "write_mp4",
]
