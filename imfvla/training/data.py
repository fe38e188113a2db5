"""Batches for a composed config: frame store, windows, augmentation, loader."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.data import Augmentation, FrameStore, Loader, ResumableSampler, Windows
from imfvla.horizon import Horizon
from imfvla.options import build
from imfvla.progress import Progress
from imfvla.recording import Recordings


def prepare_windows(config: Mapping[str, Any], demonstrations: Recordings) -> Windows:
    """The training items of recordings, whose frame store is built if out of date.

    It is stored in `demos.frames_directory`, or beside the folder of the recordings where that is null.
    """
    observation = config["observation"]
    height, width = observation["image_size"]
    directory = config["demos"]["frames_directory"] or demonstrations.directory.parent
    store_path = Path(directory) / f"{demonstrations.name}_frames_{height}x{width}"
    with _DecodingProgress() as progress:
        store = FrameStore.build(
            demonstrations, store_path, observation["image_size"], observation["views"], progress=progress
        )
    horizon = build(Horizon, config["horizon"], "horizon")
    return Windows(store, horizon, paraphrases=config["task"]["paraphrases"])


def make_loader(config: Mapping[str, Any], windows: Windows) -> Loader:
    """Augmented batches that depend only on the seed and their number."""
    augmentation = build(Augmentation, config["augmentation"], "augmentation")
    sampler = ResumableSampler(len(windows), config["training"]["batch_size"], config["seed"])
    return Loader(windows, sampler, augment=augmentation, prefetch=config["training"]["prefetch"])


class _DecodingProgress:
    """Opens a progress bar at the first call, since a store that is up to date makes no call."""

    def __enter__(self) -> "_DecodingProgress":
        self._bar: Progress | None = None
        return self

    def __call__(self, done: int, total: int) -> None:
        if self._bar is None:
            self._bar = Progress("decoding demonstrations", total).__enter__()
        self._bar.advance()

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.__exit__(*error)
