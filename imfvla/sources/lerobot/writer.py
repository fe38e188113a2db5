"""Episodes of any robot as a LeRobotDataset v3 that LeRobot opens. Shapes: T control steps, K steps with frames."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from imfvla.errors import UserError
from imfvla.recording.pictures import encode
from imfvla.robot import RobotSpec
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.checks import misfit, missing_extra
from imfvla.sources.lerobot import layout
from imfvla.sources.lerobot.series import DATA_MB, VIDEO_MB, Tables, Videos
from imfvla.sources.lerobot.statistics import KEYS, Pool, of_pictures, of_samples
from imfvla.sources.new_folder import NewFolder
from imfvla.storage.files import clear_write_errors

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise missing_extra("lerobot", error) from error

STATE, ACTION = "observation.state", "action"
BUFFERED = 100  # rows of the table of episodes in memory
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


class LeRobotWriter:
    """Writes episodes one after the other: `with LeRobotWriter(path, robot) as writer: writer.add(episode)`.

    Everything is written beside `path` and moved there at the end; after an error nothing is left. `pictures` is
    "av1" or "h264" for videos, or "png" for pictures inside the tables. A picture is repeated at steps without one.
    Raises UserError where something is at `path`, the rate is no whole number, an episode does not fit `robot`, or
    nothing can be written.
    """

    def __init__(self, path: str | Path, robot: RobotSpec, *, pictures: str = "av1") -> None:
        self.path, self._robot, self._codec = Path(path), robot, pictures
        self._folder = NewFolder(self.path, self._close, self._abort)
        self._check_robot()
        self._fps = int(robot.control_hz)
        self._keys = {f"observation.images.{camera.name}": camera for camera in robot.cameras}
        self._tasks: dict[str, int] = {}
        self._num_episodes = self._num_rows = self.num_repeats = 0
        self._pools = {key: Pool() for key in (STATE, ACTION, *COUNTERS, *self._keys)}
        self._rows: list[dict[str, Any]] = []

    def __enter__(self) -> "LeRobotWriter":
        self._root = self._folder.__enter__()
        self._data = Tables(self._root, layout.DATA, self._data_schema())
        self._meta = Tables(self._root, layout.EPISODES, self._episode_schema())
        videos = () if self._codec == "png" else self._keys.items()
        self._videos = {
            key: Videos(self._root, key, camera, self._fps, self._codec) for key, camera in videos
        }
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.__exit__(kind, error, trace)

    def add(self, episode: EpisodeArrays) -> None:
        """Appends an episode, which must have the pictures of all cameras."""
        self._check_episode(episode)
        length = len(episode.state)
        task = self._tasks.setdefault(episode.instructions[0], len(self._tasks))
        counters = {
            "timestamp": (np.arange(length) / self._fps).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, self._num_episodes),
            "index": np.arange(self._num_rows, self._num_rows + length),
            "task_index": np.full(length, task),
        }
        # The picture of each step: the last one so far.
        shown = np.searchsorted(episode.image_steps, np.arange(length), "right") - 1
        statistics = {STATE: of_samples(episode.state), ACTION: of_samples(episode.action)}
        statistics |= {key: of_samples(values[:, None]) for key, values in counters.items()}
        columns = {STATE: _vectors(episode.state), ACTION: _vectors(episode.action)}
        columns |= {key: pa.array(values) for key, values in counters.items()}
        entry: dict[str, Any] = {
            "episode_index": self._num_episodes, "tasks": [episode.instructions[0]], "length": length,
            "dataset_from_index": self._num_rows, "dataset_to_index": self._num_rows + length,
        }  # fmt: skip
        with clear_write_errors(self.path):
            for key, camera in self._keys.items():
                frames = episode.images[camera.name]
                statistics[key] = of_pictures(frames)
                if key in self._videos:
                    entry |= self._videos[key].add(frames, shown)
                else:
                    columns[key] = _embedded(frames, shown)
            table = pa.table(
                {name: columns[name] for name in self._data.schema.names}, schema=self._data.schema
            )
            place = self._data.write(table)
            entry |= {"data/chunk_index": place[0], "data/file_index": place[1]}
            for key, found in statistics.items():
                self._pools[key].add(found)
                entry |= {f"stats/{key}/{name}": found[name].tolist() for name in KEYS}
            self._rows.append(entry)
            self._num_episodes, self._num_rows = self._num_episodes + 1, self._num_rows + length
            self.num_repeats += length - len(episode.image_steps) if self._keys else 0
            if len(self._rows) == BUFFERED:
                self._flush()

    def _abort(self) -> None:
        for series in (self._data, self._meta, *self._videos.values()):
            with suppress(Exception):  # closing flushes, and a full disk must not keep the folder
                series.close()

    def _close(self) -> None:
        if self._num_episodes == 0:
            raise UserError(f"{self.path}: wanted at least one episode, found none; nothing was written.")
        self._flush()
        for series in (self._data, self._meta, *self._videos.values()):
            series.close()
        _write_tasks(self._root / layout.TASKS, self._tasks)
        stats = {
            key: {name: value.tolist() for name, value in pool.result().items()}
            for key, pool in self._pools.items()
        }
        contents = {layout.STATS: stats, layout.INFO: self._info(), layout.ROBOT: self._robot.to_json()}
        for name, value in contents.items():
            path = self._root / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(layout.dump(value), encoding="utf-8")

    def _flush(self) -> None:
        if self._rows:
            place = self._meta.place
            named = {"meta/episodes/chunk_index": place[0], "meta/episodes/file_index": place[1]}
            self._meta.write(pa.Table.from_pylist([row | named for row in self._rows], self._meta.schema))
            self._rows = []

    def _check_robot(self) -> None:
        rate = self._robot.control_hz
        if rate != int(rate):
            raise misfit(
                "robot", "control_hz", "a whole number, as LeRobot wants it", rate, "resample the data"
            )
        for camera in self._robot.cameras:
            if "/" in camera.name or "{" in camera.name or ".." in camera.name:
                raise misfit("robot", "cameras", "names without / and {", camera.name, "rename the camera")
            is_odd = camera.height % 2 or camera.width % 2
            if self._codec != "png" and is_odd:
                raise misfit(
                    "robot", f"cameras.{camera.name}", "of an even height and width for a video",
                    f"{camera.height} x {camera.width}", "write pictures=png in place of videos",
                )  # fmt: skip

    def _check_episode(self, episode: EpisodeArrays) -> None:
        wanted = {"state": len(self._robot.state), "action": len(self._robot.action)}
        for key, width in wanted.items():
            values = getattr(episode, key)
            if values.shape != (len(episode.state), width) or not np.isfinite(values).all():
                raise misfit(
                    episode.name, key, f"finite, of shape (steps, {width})", f"{values.shape}", "leave it out"
                )
        if episode.imitate is not None and not episode.imitate.all():
            skipped = f"{np.sum(~episode.imitate)} of {len(episode.state)} that are not"
            raise misfit(
                episode.name,
                "steps",
                "all to be imitated, since this format marks none",
                skipped,
                "leave it out",
            )
        for camera in self._robot.cameras:
            frames = episode.images.get(camera.name)
            shape = (len(episode.image_steps), camera.height, camera.width, 3)
            if frames is None or frames.shape != shape or not shape[0] or episode.image_steps[0] != 0:
                found = "none" if frames is None else f"{frames.shape} from step {episode.image_steps[:1]}"
                raise misfit(
                    episode.name, f"pictures of {camera.name}", f"{shape}, the first at step 0", found,
                    "leave this camera or this episode out",
                )  # fmt: skip

    def _data_schema(self) -> pa.Schema:
        def width(names: tuple[str, ...]) -> pa.DataType:
            return pa.list_(pa.float32(), len(names)) if len(names) > 1 else pa.float32()

        columns = {STATE: width(self._robot.state), ACTION: width(self._robot.action)}
        if self._codec == "png":
            picture = pa.struct({"bytes": pa.binary(), "path": pa.string()})
            columns |= dict.fromkeys(self._keys, picture)
        columns |= {key: pa.float32() if key == "timestamp" else pa.int64() for key in COUNTERS}
        return pa.schema(columns)

    def _episode_schema(self) -> pa.Schema:
        names = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
        names += [
            f"{table}/{part}_index" for table in ("data", "meta/episodes") for part in ("chunk", "file")
        ]
        columns: dict[str, pa.DataType] = dict.fromkeys(names, pa.int64())
        columns["tasks"] = pa.list_(pa.string())
        for key in self._keys if self._codec != "png" else ():
            columns |= {f"videos/{key}/{part}_index": pa.int64() for part in ("chunk", "file")}
            columns |= {f"videos/{key}/{end}_timestamp": pa.float64() for end in ("from", "to")}
        for key in self._pools:
            values = pa.list_(pa.float64())
            if key in self._keys:
                values = pa.list_(pa.list_(values))
            columns |= {
                f"stats/{key}/{name}": pa.list_(pa.int64()) if name == "count" else values for name in KEYS
            }
        return pa.schema(columns)

    def _info(self) -> dict[str, Any]:
        features: dict[str, Any] = {
            key: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
            for key, names in ((STATE, self._robot.state), (ACTION, self._robot.action))
        }
        for key, camera in self._keys.items():
            features[key] = {
                "dtype": "image" if self._codec == "png" else "video",
                "shape": [camera.height, camera.width, 3],
                "names": ["height", "width", "channels"],
            }
            if key in self._videos:
                features[key]["info"] = self._videos[key].info
        for key in COUNTERS:
            kind = "float32" if key == "timestamp" else "int64"
            features[key] = {"dtype": kind, "shape": [1], "names": None}
        return {
            "codebase_version": layout.VERSION,
            "robot_type": None,
            "total_episodes": self._num_episodes,
            "total_frames": self._num_rows,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.FILES_A_CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{self._num_episodes}"},
            "data_path": layout.DATA,
            "video_path": layout.VIDEO if self._videos else None,
            "features": features,
        }


def _vectors(values: np.ndarray) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.shape[1] > 1 else flat


def _embedded(frames: np.ndarray, shown: np.ndarray) -> pa.Array:
    encoded = [encode(np.ascontiguousarray(frame), lossless=True)[0] for frame in frames]
    cells = [{"bytes": encoded[number], "path": None} for number in shown]
    return pa.array(cells, pa.struct({"bytes": pa.binary(), "path": pa.string()}))


def _write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """The table of sentences; its metadata says which column pandas takes for the index, where LeRobot looks."""
    kinds = {"task_index": "int64", "task": "unicode"}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "metadata": None,
         "numpy_type": "int64" if name == "task_index" else "object"}
        for name, kind in kinds.items()
    ]  # fmt: skip
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table(
        {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())}
    )
    pq.write_table(table.replace_schema_metadata({"pandas": layout.dump(pandas)}), path)
