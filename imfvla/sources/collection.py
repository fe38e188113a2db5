"""Demonstrations: episodes of the scripted expert, one MCAP file each, recorded on all cores."""

import json
import logging
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypedDict

from imfvla.config.protocol import DEMONSTRATION_SEEDS, MAX_WORKERS, demonstration_seeds
from imfvla.environments.rollout import run_episode
from imfvla.errors import UserError
from imfvla.options import Limit, Plain, at_least, build, one_of, part_of, within
from imfvla.process.progress import Progress
from imfvla.recording import McapSink, Recordings, TruncatedRecording, read_index
from imfvla.robot import RobotSpec
from imfvla.sources.demonstrations import Settings, settings_of
from imfvla.storage.files import delete_leftovers, locked, write_json
from imfvla.storage.fingerprint import physical_cores
from imfvla.storage.records import Seed, read_record

LOG_NAME = "collection.json"

# A demonstration takes seconds; a worker that takes longer hangs in its graphics driver.
EPISODE_TIMEOUT_S = 900.0
NOT_EMPTY = Limit("a text that is not empty", bool)
OF_DEMONSTRATIONS = Limit(
    " or ".join(f"between {band[0]} and {band[-1]}" for band in DEMONSTRATION_SEEDS),
    lambda seed: any(seed in band for band in DEMONSTRATION_SEEDS),
)
# What folders were recorded with before a setting had a name.
LATER_SETTINGS = {"dwell": 0, "recoveries": 0, "max_turn": None}
log = logging.getLogger(__name__)


class CollectionLog(TypedDict):
    """`collection.json`: what a folder was recorded with, and the seeds at which the expert did not succeed."""

    settings: Mapping[str, Plain]
    failed_seeds: list[Seed]


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """Which demonstrations are requested and where they are stored."""

    episodes: Annotated[int, within(1, sum(map(len, DEMONSTRATION_SEEDS)))]
    first_seed: Annotated[int, OF_DEMONSTRATIONS]
    directory: Annotated[str, NOT_EMPTY]
    frames_directory: Annotated[str, NOT_EMPTY] | None  # of the frame store, see imfvla.training.data
    camera_every: Annotated[int, at_least(1)]
    workers: Annotated[int, within(0, MAX_WORKERS)] | None
    source: Annotated[str, one_of("scripted")] = "scripted"  # of imfvla.sources.opening


@dataclass(frozen=True, slots=True)
class Report:
    """What a collection did."""

    recordings: Recordings  # exactly those that were asked for
    num_new: int
    num_failed: int  # among the seeds up to the last one needed
    wall_s: float


def check_demonstrations(config: Mapping[str, Any]) -> None:
    """Raises UserError where `config` (train.yaml composed) asks for demonstrations that cannot be recorded."""
    _, settings = read_settings(*(part_of(config, key) for key in ("task", "observation", "demos")), "demos")
    _stage_for(settings)


def ensure_demonstrations(config: Mapping[str, Any]) -> Recordings:
    """Exactly the demonstrations that `config` (train.yaml composed) asks for.

    Missing ones are collected first. Raises UserError as `collect` does.
    """
    return collect(config["task"], config["observation"], config["demos"], "demos").recordings


def collect(
    task: Mapping[str, Any], observation: Mapping[str, Any], demos: Mapping[str, Any], where: str = ""
) -> Report:
    """Records demonstrations until `demos.episodes` have succeeded, from `demos.first_seed` on.

    Each success becomes `episode-<seed>.mcap` in a folder of `demos.directory` named after task, variant, modes and
    image size. Complete files are kept, so that an interrupted collection resumes; the seeds of failed demonstrations
    are listed in `collection.json`. The seeds used depend on the settings alone, not on how the work was
    distributed. Other files in the folder are neither touched nor used. `where` is the key of `demos` in the config.

    Raises:
        UserError: bad options, a folder recorded with other settings, no seeds or no disk space left.
    """
    options, settings = read_settings(task, observation, demos, where)
    # Reports what cannot be simulated before anything is written.
    _stage_for(settings)
    began = time.perf_counter()
    name = settings.folder
    directory = Path(options.directory) / name
    with locked(directory):  # other jobs of a sweep may need the same demonstrations
        listed = _Log(directory, settings)
        on_file = recorded_seeds(directory) - listed.failed
        _name_others(directory, on_file)
        usable = {seed for seed in on_file if options.first_seed <= seed and OF_DEMONSTRATIONS.holds(seed)}
        chosen = {seed for seed in usable if _is_recorded(directory, seed, settings)}
        workers = physical_cores() if options.workers is None else options.workers
        num_new = _record_missing(directory, settings, options, workers, listed, chosen)
        wanted = sorted(chosen)[: options.episodes]
        num_failed = sum(options.first_seed <= seed <= wanted[-1] for seed in listed.failed)
        if len(wanted) < len(on_file | chosen):
            name = f"{name}-seeds{options.first_seed}-n{options.episodes}"
    names = [recording_path(directory, seed).name for seed in wanted]
    return Report(Recordings.named(directory, names, name), num_new, num_failed, time.perf_counter() - began)


def read_settings(
    task: Mapping[str, Any], observation: Mapping[str, Any], demos: Mapping[str, Any], where: str
) -> tuple[DemoOptions, Settings]:
    """The checked options of a collection; `where` is the group of `demos` in messages. Raises UserError."""
    options = build(DemoOptions, demos, where)
    key = f"{where}.camera_every".lstrip(".")
    return options, settings_of(task, observation, options.camera_every, key)


def _record_missing(
    directory: Path, settings: Settings, options: DemoOptions, workers: int, listed: "_Log", chosen: set[int]
) -> int:
    """Adds to `chosen` the seeds that succeed until there are enough; returns how many were recorded."""
    batch = _next_batch(options, chosen, listed.failed)
    if not batch:
        return 0
    from imfvla.process.workers import worker_pool

    num_new, title = 0, f"demonstrations of {settings.task}"
    with (
        worker_pool(min(workers, len(batch)), EPISODE_TIMEOUT_S) as run_all,
        Progress(title, options.episodes, done=options.episodes - len(batch)) as bar,
    ):
        while batch:
            for seed, success in run_all(record_demonstration, [(settings, directory, s) for s in batch]):
                if success:
                    chosen.add(seed)
                    num_new += 1
                    bar.advance(f"{len(listed.failed)} failed")
                else:
                    listed.add_failure(seed)
            batch = _next_batch(options, chosen, listed.failed)
    return num_new


def _next_batch(options: DemoOptions, chosen: set[int], failed: set[int]) -> list[int]:
    """The lowest untried seeds: just enough of them if all succeed."""
    batch: list[int] = []
    num_good = 0
    for seed in demonstration_seeds(options.first_seed):
        if num_good + len(batch) == options.episodes:
            return batch
        if seed in chosen:
            num_good += 1
        elif seed not in failed:
            batch.append(seed)
    if num_good + len(batch) == options.episodes:
        return batch
    raise UserError(
        f"demos.episodes={options.episodes} cannot be collected: the seeds for demonstrations end at "
        f"{DEMONSTRATION_SEEDS[-1][-1]}, and from {options.first_seed} on {len(failed)} failed; ask for fewer or lower "
        "demos.first_seed."
    )


def record_demonstration(settings: Settings, directory: Path, seed: int) -> tuple[int, bool]:
    """Records the expert from `seed` into its file; a failed demonstration leaves no file. Runs in a worker."""
    env, expert = _stage_for(settings)
    path = recording_path(directory, seed)
    sink = McapSink(path, lossless=True, render_every=settings.camera_every, only_success=True)
    result = run_episode(env, expert, seed, [sink], kind="demonstration", config=settings.to_json())
    return seed, result.success


@lru_cache(maxsize=1)
def _stage_for(settings: Settings) -> tuple[Any, Any]:
    return settings.build()


class _Log:
    """`collection.json`: what the folder was recorded with and which seeds failed.

    A folder without recordings accepts other settings, so that a collection that failed at once blocks nothing.
    """

    def __init__(self, directory: Path, settings: Settings) -> None:
        self._path = directory / LOG_NAME
        delete_leftovers(self._path)
        self._remedy = f"choose another demos.directory, or move {directory} away to record it again"
        env, _ = _stage_for(settings)
        self._settings = json.loads(json.dumps(settings.to_json())) | {"model": env.model_digest()}
        self.failed: set[int] = set()
        is_empty = next(directory.glob("episode-*.mcap"), None) is None
        if self._path.exists():
            found, failed = self._read()
            settings = LATER_SETTINGS | self._settings
            differing = [key for key, wanted in settings.items() if found.get(key) != wanted]
            if not differing:
                self.failed = failed
                return
            if not is_empty:
                key = differing[0]
                raise UserError(
                    f"{directory} was recorded with {key}={found.get(key)!r}, but {settings[key]!r} is wanted; "
                    f"{self._remedy}."
                )
        elif not is_empty:
            raise UserError(
                f"{directory} holds recordings, but no {LOG_NAME} that says what they were recorded with: restore "
                f"it, or {self._remedy}."
            )
        self._write()

    def add_failure(self, seed: int) -> None:
        self.failed.add(seed)
        self._write()

    def _read(self) -> tuple[dict[str, Any], set[int]]:
        """The settings and the seeds that failed."""
        try:
            found = read_record(self._path, CollectionLog, "restore it")
        except UserError as error:
            raise UserError(f"{self._path} is damaged ({error}); {self._remedy}.") from error
        return LATER_SETTINGS | found["settings"], set(found["failed_seeds"])

    def _write(self) -> None:
        write_json(self._path, {"settings": self._settings, "failed_seeds": sorted(self.failed)})


def recording_path(directory: Path, seed: int) -> Path:
    """Where a folder has the demonstration of `seed`."""
    return directory / f"episode-{seed:06d}.mcap"


def recorded_seeds(directory: Path) -> set[int]:
    """The seeds of which a folder has files, whole or not."""
    found = (
        re.fullmatch(r"episode-(\d{6}|[1-9]\d{6})\.mcap", path.name) for path in directory.glob("*.mcap")
    )
    return {int(match.group(1)) for match in found if match}


def _name_others(directory: Path, seeds: set[int]) -> None:
    """Warns of recordings in the folder that do not belong to `seeds`."""
    ours = {recording_path(directory, seed) for seed in seeds}
    if others := sorted(path.name for path in directory.glob("*.mcap") if path not in ours):
        log.warning(
            f"{directory} holds files that are not demonstrations of this collection and are not used: "
            f"{', '.join(map(repr, others))}."
        )


def _is_recorded(directory: Path, seed: int, settings: Settings) -> bool:
    """Whether the recording of `seed` is whole; UserError where its file holds another episode."""
    path = recording_path(directory, seed)
    try:
        info = read_index(path).info
    except TruncatedRecording:
        return False
    found = (info.kind, info.task, info.seed, info.views, sizes_of(info.robot))
    wanted = ("demonstration", settings.task, seed, settings.views, settings.sizes)
    if found != wanted:
        raise UserError(
            f"{path} must hold kind, task, seed, views and their sizes {wanted}, found {found}: its file was "
            "renamed; move it away."
        )
    return True


def sizes_of(robot: RobotSpec) -> tuple[tuple[int, int], ...]:
    """(H, W) [px] of the cameras, in their order."""
    return tuple((camera.height, camera.width) for camera in robot.cameras)
