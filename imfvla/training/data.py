"""Batches for a composed config: frame store, windows, augmentation, loader."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from imfvla.config.horizon import Horizon
from imfvla.config.views import view_options
from imfvla.data import Augmentation, FrameStore, Loader, ResumableSampler, Windows
from imfvla.data.held_out import held_out
from imfvla.options import build
from imfvla.process.progress import Progress
from imfvla.robot_of import place_of_robot, robot_of, with_robot
from imfvla.sources.base import EpisodeSource
from imfvla.sources.mcap import McapSource
from imfvla.sources.opening import source_kind
from imfvla.sources.same_robot import refuse_other_data
from imfvla.sources.validation import check_episode
from imfvla.training.experiment import ExperimentOptions

STORES = Path("data/frames")  # of sources that are no folder of recordings
DIGITS = 12  # of a source's digest in the name of its store


def prepare_windows(config: Mapping[str, Any], source: EpisodeSource) -> Windows:
    """The training items of a source of episodes, whose frame store is built if out of date.

    Raises UserError where its robot is not the config's, where an episode is damaged, or where nothing can be written.
    """
    config = with_robot(config)
    robot = robot_of(config)
    refuse_other_source(config, source)
    seen = view_options(config)
    with _DecodingProgress() as progress:
        store = FrameStore.build(
            source,
            store_path(config, source),
            seen.image_size,
            seen.views,
            progress=progress,
        )
    kept = held_out(config["task"], len(source))
    horizon = build(Horizon, config["horizon"], "horizon")
    trained = set(range(len(source))) - set(kept)
    return Windows(store, horizon, robot, paraphrases=config["task"]["paraphrases"], episodes=trained)


def check_episodes(config: Mapping[str, Any], source: EpisodeSource) -> None:
    """Reads the numbers of all episodes, without pictures, unless the frame store shows that they were read before.

    Raises UserError naming the first episode that is damaged, or has a number that is not finite.
    """
    seen = view_options(config)
    if FrameStore.is_current(source, store_path(config, source), seen.image_size, seen.views):
        return
    with Progress("checking episodes", len(source)) as bar:
        for index in range(len(source)):
            check_episode(source.episode(index), source.robot, ())
            bar.advance()


def held_out_windows(windows: Windows) -> Windows:
    """The decisions of the episodes that training windows leave out, with the recorded sentences."""
    others = set(range(len(windows.store.episodes))) - set(windows.chosen)
    return Windows(windows.store, windows.horizon, windows.robot, paraphrases=False, episodes=others)


def refuse_other_source(config: Mapping[str, Any], source: EpisodeSource) -> None:
    """Raises UserError where the episodes are of another robot than the one that the config trains for."""
    refuse_other_data(
        robot_of(config),
        source.robot,
        view_options(config).views,
        of=place_of_robot(config),
        where=f"the data of demos.source={source_kind(config)}",
        remedy="Correct the one that is wrong, or choose data and a task of the same robot.",
    )


def store_path(config: Mapping[str, Any], source: EpisodeSource) -> Path:
    """Where decoded frames lie: in `demos.frames_directory`, or beside a folder of recordings, or in `data/frames`."""
    height, width = view_options(config).image_size
    chosen = config["demos"].get("frames_directory")
    if isinstance(source, McapSource):
        directory, name = source.recordings.directory.parent, source.recordings.name
    else:
        directory, name = STORES, f"{source_kind(config)}-{source.digest()[:DIGITS]}"
    return Path(chosen or directory) / f"{name}_frames_{height}x{width}"


def make_loader(options: ExperimentOptions, windows: Windows) -> Loader:
    """Augmented batches that depend only on the seed and their number."""
    sampler = ResumableSampler(len(windows), options.training.batch_size, options.seed)
    training = options.training
    return Loader(
        windows,
        sampler,
        augment=Augmentation(**asdict(options.augmentation)),
        prefetch=training.prefetch,
        threads=training.loader_threads,
    )


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
