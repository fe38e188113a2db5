"""Episodes of a LeRobotDataset v3. Shapes: T control steps, K steps with frames, S state, A action."""

import hashlib
import json
import logging
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imfvla.documents import read_json
from imfvla.errors import UserError
from imfvla.options import Limit, at_least, build, some
from imfvla.recording.pictures import decode, size_of
from imfvla.robot import Camera, RobotSpec, bare_name
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.checks import action_range, bounded_pictures, channels, displaced, misfit, numbers
from imfvla.sources.lerobot.layout import DOWNLOAD, NUMERIC, ROBOT, STATS, TASKS, Feature, read_info
from imfvla.sources.lerobot.tables import batches, read_episodes, read_rows, read_tasks, scalars, vectors
from imfvla.sources.lerobot.video import read_frames

log = logging.getLogger(__name__)
PREFIX = "observation.images."
TIME_TOLERANCE = 0.1  # of a period: how far a timestamp may lie from its step
NAMES = some(Limit("the name of a feature", bool))


@dataclass(frozen=True, slots=True)
class Options:
    """What conf/demos/lerobot.yaml documents."""

    path: str
    episodes: tuple[Annotated[int, at_least(0)], ...] | None
    state: Annotated[tuple[str, ...], NAMES]
    action: Annotated[tuple[str, ...], NAMES]
    cameras: Any  # a mapping view -> feature, or null for all
    state_names: tuple[str, ...] | None
    action_names: tuple[str, ...] | None
    absolute: tuple[str, ...] | None
    action_min: tuple[float, ...] | None
    action_max: tuple[float, ...] | None
    camera_every: Annotated[int, at_least(1)]
    instruction: str | None


class LeRobotSource:
    """An `EpisodeSource` on the folder of a LeRobotDataset v3; everything is opened anew in each call."""

    robot: RobotSpec

    def __init__(self, options: Options, where: str) -> None:
        self._options, self._where = options, where
        self._root = Path(options.path)
        self._info = info = read_info(self._root)
        self._state, self._action = self._chosen(options.state), self._chosen(options.action)
        self._cameras = self._chosen_cameras()
        self._episodes = read_episodes(info, [c.key for c in self._cameras.values() if c.dtype == "video"])
        self._tasks = read_tasks(info)
        numbers = range(info.num_episodes) if options.episodes is None else options.episodes
        if beyond := [number for number in numbers if number >= info.num_episodes]:
            raise UserError(
                f"{where}.episodes must be below {info.num_episodes}, the number in {info.path}, found {beyond[0]}."
            )
        if not numbers or len(set(numbers)) < len(numbers):
            raise UserError(
                f"{where}.episodes must be null or numbers that all differ, found {list(numbers)}."
            )
        self._numbers = tuple(numbers)
        self.robot = self._spec()
        relative = sum(index is not None for index in self.robot.relative_to)
        log.info(
            "%s: %d episodes at %g Hz; %d of %d actions are learned relative to the state of their name.",
            self._root, len(self), info.fps, relative, len(self.robot.action),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self._numbers)

    def num_frames(self, index: int) -> int:
        length = int(self._episodes.length[self._numbers[index]])
        return -(-length // self._options.camera_every) if self._cameras else 0

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        number = self._numbers[index]
        length = int(self._episodes.length[number])
        path = self._info.data_file(*map(int, self._episodes.data[number]))
        pictures = {view: self._cameras[self.robot.camera(view).name] for view in views}
        embedded = [feature.key for feature in pictures.values() if feature.dtype == "image"]
        features = [feature.key for feature in (*self._state, *self._action)]
        columns = [*dict.fromkeys([*features, "episode_index", "frame_index", "timestamp", "task_index"])]
        first = int(self._episodes.first_row[number])
        table = read_rows(path, columns, first, length)
        self._check_rows(table, number, path)
        steps = np.arange(0, length, self._options.camera_every) if self._cameras else np.zeros(0, np.int64)
        images = {}
        for view, feature in pictures.items():
            if feature.key in embedded:
                images[view] = self._embedded(path, feature, first, length)
            else:
                places, starts = self._episodes.videos[feature.key]
                video = self._info.video_file(feature.key, *map(int, places[number]))
                size = feature.picture_size(self._info.path)
                images[view] = read_frames(
                    video, starts[number] + steps / self._info.fps, self._info.fps, size
                )
        task = self._task(table, number, path)
        return EpisodeArrays(
            name=f"episode_{number:06d}",
            task=task,
            instructions=(self._options.instruction or task,),
            state=self._numbers_of(table, self._state, path, self.robot.state),
            action=self._numbers_of(table, self._action, path, self.robot.action),
            image_steps=steps,
            images=images,
        )

    def digest(self) -> str:
        """Sizes and times of change of the data and videos, contents of the metadata, options."""
        digest = hashlib.sha256(
            json.dumps([asdict(self._options), self.robot.to_json()], default=str).encode()
        )
        for path in sorted((self._root / "meta").rglob("*")):
            if path.is_file():
                digest.update(path.relative_to(self._root).as_posix().encode() + path.read_bytes())
        for path in self._content():
            status = path.stat()
            name = path.relative_to(self._root).as_posix()
            digest.update(json.dumps([name, status.st_size, status.st_mtime_ns]).encode())
        return digest.hexdigest()

    def _content(self) -> list[Path]:
        """The data and video files of the chosen episodes. Raises UserError where one is missing."""
        chosen = np.array(self._numbers)
        files = {
            self._info.data_file(*place) for place in np.unique(self._episodes.data[chosen], axis=0).tolist()
        }
        for key, (places, _) in self._episodes.videos.items():
            files |= {
                self._info.video_file(key, *place) for place in np.unique(places[chosen], axis=0).tolist()
            }
        for path in sorted(files):
            if not path.is_file():
                raise UserError(f"{path} is missing: {self._info.path} names it; {DOWNLOAD}.")
        return sorted(files)

    def _chosen(self, keys: tuple[str, ...]) -> list[Feature]:
        """Numeric features. Raises UserError where one is missing or no list of numbers."""
        known = self._info.features
        numeric = [key for key, feature in known.items() if NUMERIC.fullmatch(feature.dtype)]
        for key in keys:
            if key not in known:
                raise misfit(
                    self._info.path, "features", f"with {key}", ", ".join(known),
                    f"choose among {', '.join(numeric)} in {self._where}",
                )  # fmt: skip
            feature = known[key]
            if key not in numeric or len(feature.shape) != 1 or feature.shape[0] < 1:
                raise misfit(
                    self._info.path, f"features.{key}", "a list of numbers",
                    f"{feature.dtype} of shape {list(feature.shape)}",
                    f"choose among {', '.join(numeric)} in {self._where}",
                )  # fmt: skip
        return [known[key] for key in keys]

    def _chosen_cameras(self) -> dict[str, Feature]:
        """View -> feature: those of the options, else all colour cameras."""
        known = {key: feature for key, feature in self._info.features.items() if feature.is_camera}
        chosen = self._options.cameras
        if chosen is None:
            colour = {key: feature for key, feature in known.items() if not feature.is_depth}
            views = {key: key.removeprefix(PREFIX).rpartition(".")[2] for key in colour}
            is_unique = len(set(views.values())) == len(views)
            return {views[key] if is_unique else key: feature for key, feature in colour.items()}
        key = f"{self._where}.cameras"
        if not isinstance(chosen, Mapping):
            raise UserError(f"{key} must be null or a mapping of views to features, found {chosen!r}.")
        for view, name in chosen.items():
            if name not in known:
                raise UserError(f"{key}.{view} must be one of {', '.join(known) or 'none'}, found {name!r}.")
        return {str(view): known[name] for view, name in chosen.items()}

    def _spec(self) -> RobotSpec:
        options, where = self._options, self._where
        state = self._names(self._state, options.state_names, f"{where}.state_names")
        action = self._names(self._action, options.action_names, f"{where}.action_names")
        cameras = tuple(
            Camera(view, *feature.picture_size(self._info.path)) for view, feature in self._cameras.items()
        )
        if (stored := self._stored_robot(state, action)) is not None and options.absolute is None:
            relative_to = stored.relative_to
        else:
            relative_to = displaced(state, action, options.absolute, where)
        stated = (options.action_min, options.action_max)
        if stored is not None:
            seen = np.array(stored.action_min), np.array(stored.action_max)
        else:
            seen = (np.zeros(len(action)), np.ones(len(action))) if None not in stated else self._seen_range()
        low, high = action_range(action, stated, seen, where)
        return RobotSpec(state, action, relative_to, low, high, self._info.fps, cameras)

    def _stored_robot(self, state: tuple[str, ...], action: tuple[str, ...]) -> RobotSpec | None:
        """The robot that imfvla wrote into the data set, if it did and no channel was chosen or named otherwise."""
        path = self._root / ROBOT
        if not path.is_file():
            return None
        try:
            robot = RobotSpec.from_json(read_json(path, DOWNLOAD, mapping=True))
        except UserError as error:
            raise UserError(f"{path}: {error} LeRobot does not need this file: correct it or move it away.") from error
        return robot if (robot.state, robot.action) == (state, action) else None

    def _names(self, features: list[Feature], given: tuple[str, ...] | None, key: str) -> tuple[str, ...]:
        """Names of channels: those of the options, else the data set's, with the feature where two are equal."""
        width = sum(feature.shape[0] for feature in features)
        if given is not None:
            if len(given) != width:
                wanted = " + ".join(f"{feature.key} ({feature.shape[0]})" for feature in features)
                raise UserError(f"{key} must have {width} names, of {wanted}, found {len(given)}.")
            return channels(given, key, need_units=False)
        names = [
            name
            for feature in features
            for name in feature.names or [f"{feature.key}_{place}" for place in range(feature.shape[0])]
        ]
        if len(set(map(bare_name, names))) < len(names):
            names = [
                f"{feature.key}/{name}"
                for feature in features
                for name in feature.names or [str(place) for place in range(feature.shape[0])]
            ]
        return channels(names, key, need_units=False)

    def _seen_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest actions (A,): of meta/stats.json, or of the data where it has none."""
        path = self._root / STATS
        if path.is_file():
            stats = read_json(path, DOWNLOAD, mapping=True)
            found = [_stated(stats, feature, path) for feature in self._action]
            if None not in found:
                return np.concatenate([low for low, _ in found]), np.concatenate([high for _, high in found])
        low, high = None, None
        for index in range(len(self)):
            action = self._action_of(index)
            low = action.min(0) if low is None else np.minimum(low, action.min(0))
            high = action.max(0) if high is None else np.maximum(high, action.max(0))
        return low, high

    def _action_of(self, index: int) -> np.ndarray:
        number = self._numbers[index]
        path = self._info.data_file(*map(int, self._episodes.data[number]))
        first, length = int(self._episodes.first_row[number]), int(self._episodes.length[number])
        table = read_rows(path, [feature.key for feature in self._action], first, length)
        return self._numbers_of(table, self._action, path, ())

    def _numbers_of(
        self, table: Any, features: list[Feature], path: Path, names: tuple[str, ...]
    ) -> np.ndarray:
        parts = [vectors(table, feature.key, feature.shape[0], path) for feature in features]
        keys = ", ".join(feature.key for feature in features)
        array = np.concatenate(parts, 1)
        return numbers(array, array.shape[1], path, keys, names)

    def _check_rows(self, table: Any, number: int, path: Path) -> None:
        """Raises UserError where the rows are another episode's, or were recorded at another rate."""
        if not (scalars(table, "episode_index", path) == number).all():
            found = np.unique(scalars(table, "episode_index", path))[:5].tolist()
            raise misfit(path, f"episode_index of the rows of episode {number}", str(number), found, DOWNLOAD)
        steps = np.arange(len(table))
        if not np.array_equal(scalars(table, "frame_index", path), steps):
            raise misfit(path, f"frame_index of episode {number}", "0, 1, 2, ...", "other numbers", DOWNLOAD)
        times = scalars(table, "timestamp", path).astype(np.float64)
        times = times - times[0]
        if not (np.abs(times - steps / self._info.fps) <= TIME_TOLERANCE / self._info.fps).all():
            rate = (len(times) - 1) / times[-1] if times[-1] > 0 else float("nan")
            raise misfit(
                path,
                f"timestamp of episode {number}",
                f"steps of {self._info.fps:g} Hz, the fps of {self._info.path}",
                f"{rate:.4g} Hz on average",
                "correct fps, or leave the episode out",
            )

    def _task(self, table: Any, number: int, path: Path) -> str:
        found = np.unique(scalars(table, "task_index", path)).tolist()
        if len(found) > 1 and self._options.instruction is None:
            sentences = [self._tasks.get(int(task), "?") for task in found]
            raise misfit(
                path, f"task_index of episode {number}", "one task (changes within an episode are not supported)",
                sentences, f"set {self._where}.instruction, or leave the episode out",
            )  # fmt: skip
        if int(found[0]) not in self._tasks:
            raise misfit(
                path, f"task_index of episode {number}", f"a row of {TASKS}", int(found[0]), DOWNLOAD
            )
        return self._tasks[int(found[0])]

    def _embedded(self, path: Path, feature: Feature, first: int, length: int) -> np.ndarray:
        """Pictures that lie in the parquet file: uint8 (K, H, W, 3)."""
        size, every = feature.picture_size(self._info.path), self._options.camera_every
        bounded_pictures(-(-length // every), *size, path, feature.key)
        frames = np.empty((-(-length // every), *size, 3), np.uint8)
        step = 0
        for table in batches(path, [feature.key], first, length):
            for cell in table[feature.key]:
                if step % every == 0:
                    frames[step // every] = _picture(
                        cell.as_py(), size, path, f"{feature.key} of row {first + step}"
                    )
                step += 1
        return frames


def _picture(cell: Any, size: tuple[int, int], path: Path, key: str) -> np.ndarray:
    data = cell.get("bytes") if isinstance(cell, dict) else None
    if not isinstance(data, bytes):
        raise misfit(
            path, key, "a picture inside the file (paths to other files are not supported)", cell,
            "write the data set with embedded pictures",
        )  # fmt: skip
    try:
        if size_of(data) != size:
            raise ValueError(f"a picture of {size_of(data)}")
        return decode(data)
    except ValueError as error:
        wanted = f"a PNG or JPEG of {size[0]} x {size[1]}"
        raise misfit(path, key, wanted, str(error), DOWNLOAD) from error


def _stated(stats: Mapping[str, Any], feature: Feature, path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Least and greatest values of a feature, None where the statistics have none."""
    entry = stats.get(feature.key)
    if not isinstance(entry, dict) or not {"min", "max"} <= entry.keys():
        return None
    found = []
    for key in ("min", "max"):
        try:
            values = np.array(entry[key], np.float64).reshape(-1)
        except (ValueError, TypeError):
            values = np.zeros(0)
        if values.shape != feature.shape or not np.isfinite(values).all():
            raise misfit(
                path, f"{feature.key}.{key}", f"{feature.shape[0]} finite numbers", entry[key],
                "state action_min and action_max in the options",
            )  # fmt: skip
        found.append(values)
    return found[0], found[1]


def open_source(options: Mapping[str, Any], *, where: str = "demos") -> LeRobotSource:
    """The episodes of a LeRobotDataset v3, as `conf/demos/lerobot.yaml` documents; `where` heads every message.

    Raises UserError naming file or key where the options or the data set are not as they must be.
    """
    return LeRobotSource(build(Options, options, where), where)
