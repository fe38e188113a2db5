"""Batches for a composed config: frame store, windows, augmentation, loader."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.data import Augmentation, FrameStore, Loader, ResumableSampler, Windows
from imfvla.horizon import Horizon
from imfvla.options import build
from imfvla.progress import Progress


def prepare_windows(config: Mapping[str, Any], demonstrations: Path) -> Windows:
    """The training items of a folder of recordings, whose frame store beside it is built if out of date."""
    observation = config["observation"]
    height, width = observation["image_size"]
    store_path = demonstrations.with_name(f"{demonstrations.name}_frames_{height}x{width}")
    with _DecodingProgress() as progress:
        store = FrameStore.build(
            demonstrations, store_path, observation["image_size"], observation["views"], progress=progress
        )
    horizon = build(Horizon, config["horizon"], "horizon")
    return Windows(store, horizon, paraphrases=config["task"]["paraphrases"])


def make_loader(config: Mapping[str, Any], windows: Windows) -> Loader:
    """Augmented batches that depend on the seed and their number alone."""
    augmentation = build(Augmentation, config["augmentation"], "augmentation")
    sampler = ResumableSampler(len(windows), config["training"]["batch_size"], config["seed"])
    return Loader(windows, sampler, augment=augmentation, prefetch=config["training"]["prefetch"])


class _DecodingProgress:
    """Opens a progress bar at the first call, since a store that is up to date makes none."""

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
