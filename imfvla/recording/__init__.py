"""Episodes as MCAP files that open directly in Foxglove, and as videos."""

from imfvla.recording.folder import Recordings
from imfvla.recording.mcap_file import TruncatedRecording
from imfvla.recording.mcap_index import EpisodeIndex, read_index
from imfvla.recording.mcap_reader import Episode, read_episode
from imfvla.recording.mcap_sink import McapSink
from imfvla.recording.video import VideoSink, write_mp4

__all__ = [
    "Episode",
    "EpisodeIndex",
    "McapSink",
    "Recordings",
    "TruncatedRecording",
    "VideoSink",
    "read_episode",
    "read_index",
    "write_mp4",
]
