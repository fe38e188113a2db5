"""From recorded episodes to training batches: frame store, windows, sampler, loader, augmentation."""

from imfvla.data.augment import Augmentation
from imfvla.data.frame_store import FrameStore
from imfvla.data.loader import Loader
from imfvla.data.sampler import ResumableSampler
from imfvla.data.statistics import Statistics
from imfvla.data.windows import Windows

__all__ = ["Augmentation", "FrameStore", "Loader", "ResumableSampler", "Statistics", "Windows"]
