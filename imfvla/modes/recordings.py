"""Which recordings samples are judged on: demonstrations of the run's own task that it was not trained on."""

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from imfvla.config.protocol import REPORTING_FIRST_SEED, demonstration_seeds
from imfvla.environments import BIMANUAL, KIND, kind_of
from imfvla.errors import UserError
from imfvla.process.progress import Progress
from imfvla.recording import Episode, read_episode
from imfvla.sources.collection import (
    LATER_SETTINGS,
    LOG_NAME,
    CollectionLog,
    read_settings,
    record_demonstration,
    recorded_seeds,
    recording_path,
    sizes_of,
)
from imfvla.sources.demonstrations import BimanualSettings
from imfvla.storage.files import locked
from imfvla.storage.records import read_record

MOST_FAILURES = 20  # of the expert, before it is given up
# What a recording must share with the run. Its noise, and the time held after success, may differ.
SHARED = ("task", "variant", "modes", "dwell", "recoveries", "max_turn", "image_size")
REMEDY = "leave --demos out to have the expert play"


def settings_of(config: Mapping[str, Any]) -> BimanualSettings:
    """How the demonstrations of a run were recorded, also of one that is older than some of the settings."""
    task, demos = config["task"], config["demos"]
    if kind_of(task) != BIMANUAL or not isinstance(task.get("expert"), Mapping):
        raise UserError(
            f"The run must be of one of this package's own tasks, found task={task.get('name')} of {KIND}="
            f"{kind_of(task)}: the hidden choice of other experts is not known."
        )
    task = {**task, "expert": LATER_SETTINGS | task["expert"]}
    _, settings = read_settings(task, config["observation"], {"frames_directory": None} | demos, "demos")
    return settings


def trained_seeds(config: Mapping[str, Any], failed: set[int]) -> set[int]:
    """The seeds of the demonstrations of a run; `failed` are those at which the expert did not succeed."""
    seeds = (seed for seed in demonstration_seeds(config["demos"]["first_seed"]) if seed not in failed)
    return set(islice(seeds, config["demos"]["episodes"]))


def record_starts(config: Mapping[str, Any], directory: Path, first_seed: int, episodes: int) -> list[Path]:
    """Plays the expert of a run from `first_seed` on until so many have succeeded; what is there is kept.

    The recordings lie in a folder of `directory` that is named as those of demonstrations are.
    """
    settings = settings_of(config)
    if first_seed >= REPORTING_FIRST_SEED:
        raise UserError(
            f"--first-seed must be below {REPORTING_FIRST_SEED}: the starts from there on are for reporting, found "
            f"{first_seed}."
        )
    _refuse_trained(first_seed, trained_seeds(config, set()))
    folder = directory / settings.folder
    found: list[Path] = []
    with locked(folder), Progress("recorded starts", episodes) as bar:
        for seed in range(first_seed, first_seed + episodes + MOST_FAILURES):
            path = recording_path(folder, seed)
            if path.exists() or record_demonstration(settings, folder, seed)[1]:
                found.append(path)
                bar.advance()
            if len(found) == episodes:
                return found
    raise UserError(
        f"The expert of {settings.task} succeeded from {len(found)} of {episodes + MOST_FAILURES} seeds only, from "
        f"{first_seed} on: choose others with --first-seed."
    )


def choose_recordings(
    config: Mapping[str, Any], directory: Path, first_seed: int | None, episodes: int
) -> list[Path]:
    """The first recordings of a folder, from `first_seed` on, that the run was not trained on.

    Raises UserError where the folder has none, and where `first_seed` is one that the run was trained on.
    """
    seeds = sorted(recorded_seeds(directory))
    if not seeds:
        raise UserError(
            f"No demonstrations (episode-<seed>.mcap) in {directory}: correct --demos, or {REMEDY}."
        )
    trained = trained_seeds(config, _failed_seeds(directory))
    if first_seed is not None:
        _refuse_trained(first_seed, trained)
    usable = [seed for seed in seeds if seed not in trained and seed >= (first_seed or 0)]
    if not usable:
        lowest = "" if first_seed is None else f" from seed {first_seed} on"
        raise UserError(
            f"{directory} has no demonstration{lowest} that the run was not trained on: it has seeds {seeds[0]} to "
            f"{seeds[-1]}, trained on were {min(trained)} to {max(trained)}. Record more, or {REMEDY}."
        )
    return [recording_path(directory, seed) for seed in usable[:episodes]]


def read_demonstration(path: Path, settings: BimanualSettings) -> Episode:
    """A recording with the run's views. Raises UserError where it is of another task, expert or picture size."""
    episode = read_episode(path, images=settings.views)
    if episode.info.kind != "demonstration":
        raise UserError(f"{path} must be a demonstration, found a {episode.info.kind}: correct --demos.")
    recorded = LATER_SETTINGS | dict(episode.info.config)
    size = sizes_of(episode.info.robot)[0]  # of all, as of the run's: our own tasks have one size
    recorded |= {"task": episode.info.task, "image_size": list(size)}
    for key in SHARED:
        wanted = getattr(settings, key)
        wanted = list(wanted) if isinstance(wanted, tuple) else wanted
        if recorded.get(key, wanted) != wanted:
            raise UserError(
                f"{path} was recorded with {key}={recorded[key]!r}, the run is of {key}={wanted!r}: choose "
                f"demonstrations of the run's own task, or {REMEDY}."
            )
    return episode


def _refuse_trained(first_seed: int, trained: set[int]) -> None:
    if first_seed in trained:
        raise UserError(
            f"--first-seed must be one that the run was not trained on, found {first_seed}: trained on were "
            f"{min(trained)} to {max(trained)}."
        )


def _failed_seeds(directory: Path) -> set[int]:
    """The seeds that a collection lists as failed; none where the folder has no list."""
    path = directory / LOG_NAME
    if not path.exists():
        return set()
    return set(read_record(path, CollectionLog, "restore it, or take it away")["failed_seeds"])
