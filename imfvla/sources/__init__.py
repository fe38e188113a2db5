"""Where episodes to learn from come from; `base` says what every source offers."""

from imfvla.sources.base import EpisodeArrays, EpisodeSource

__all__ = ["EpisodeArrays", "EpisodeSource"]
