"""Episodes of a LeRobotDataset v3. Shapes: T control steps, K steps with frames, S state, A action."""

import logging
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.options import build
from imfvla.recording.pictures import decode, size_of
from imfvla.robot import RobotSpec
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.checks import bounded_pictures, chosen_episodes, digest_of, misfit, numbers
from imfvla.sources.lerobot.features import Options, Range, chosen, chosen_cameras, robot_of
from imfvla.sources.lerobot.layout import DOWNLOAD, TASKS, Feature, read_info
from imfvla.sources.lerobot.tables import batches, read_episodes, read_rows, read_tasks, scalars, vectors
from imfvla.sources.lerobot.video import read_frames

log = logging.getLogger(__name__)
TIME_TOLERANCE = 0.1  # of a period: how far a timestamp may lie from its step


class LeRobotSource:
    """An `EpisodeSource` on the folder of a LeRobotDataset v3; each call opens its files itself."""

    robot: RobotSpec

    def __init__(self, options: Options, where: str) -> None:
        self._options, self._where = options, where
        self._root = Path(options.path)
        self._info = info = read_info(self._root)
        self._state = chosen(info, options.state, f"{where}.state")
        self._action = chosen(info, options.action, f"{where}.action")
        self._cameras = chosen_cameras(info, options.cameras, where)
        self._episodes = read_episodes(info, [c.key for c in self._cameras.values() if c.dtype == "video"])
        self._tasks = read_tasks(info)
        self._numbers = chosen_episodes(options.episodes, info.num_episodes, info.path, where)
        self.robot = robot_of(
            info, self._state, self._action, self._cameras, options, where, self._range_in_data
        )
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
        features = [feature.key for feature in (*self._state, *self._action)]
        columns = [*dict.fromkeys([*features, "episode_index", "frame_index", "timestamp", "task_index"])]
        first = int(self._episodes.first_row[number])
        table = read_rows(path, columns, first, length)
        self._check_rows(table, number, path)
        steps = np.arange(0, length, self._options.camera_every) if self._cameras else np.zeros(0, np.int64)
        images = {}
        for view, feature in pictures.items():
            if feature.dtype == "image":
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
        """Of the sizes and times of change of all files that are read, and of the options."""
        root, meta = self._root, self._root / "meta"
        files = [path for path in meta.rglob("*") if path.is_file()]
        files += {self._info.data_file(*place) for place in self._places(self._episodes.data)}
        for key, (places, _) in self._episodes.videos.items():
            files += {self._info.video_file(key, *place) for place in self._places(places)}
        options = {key: value for key, value in asdict(self._options).items() if key != "path"}
        return digest_of(root, files, [options, self.robot.to_json()])

    def _places(self, places: np.ndarray) -> list[list[int]]:
        """Chunk and file of the chosen episodes, each once."""
        return np.unique(places[list(self._numbers)], axis=0).tolist()

    def _range_in_data(self) -> Range:
        """Least and greatest actions (A,) of the chosen episodes."""
        lows, highs = [], []
        for number in self._numbers:
            path = self._info.data_file(*map(int, self._episodes.data[number]))
            first, length = int(self._episodes.first_row[number]), int(self._episodes.length[number])
            table = read_rows(path, [feature.key for feature in self._action], first, length)
            action = self._numbers_of(table, self._action, path, ())
            lows.append(action.min(0))
            highs.append(action.max(0))
        return np.min(lows, 0), np.max(highs, 0)

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


def open_source(options: Mapping[str, Any], *, where: str = "demos") -> LeRobotSource:
    """The episodes of a LeRobotDataset v3, as `conf/demos/lerobot.yaml` documents; `where` heads every message.

    Raises UserError naming file or key where the options or the data set are not as they must be.
    """
    return LeRobotSource(build(Options, options, where), where)
