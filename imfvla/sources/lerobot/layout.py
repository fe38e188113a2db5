"""Where a LeRobotDataset v3 keeps what, and what its meta/info.json says of it."""

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.options import is_whole
from imfvla.sources.checks import MAX_EPISODES, misfit, shortened
from imfvla.storage.documents import read_json

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
ROBOT = "meta/imfvla_robot.json"  # ours: limits and relative actions, for which LeRobot has no place
FILES_A_CHUNK = 1000
NUMERIC = re.compile(r"(float|int|uint)(8|16|32|64)|bool")
_HOLE = re.compile(r"\{(\w+)(?::0?(\d))?d?\}")
DOWNLOAD = "copy or download the data set again"


@dataclass(frozen=True, slots=True)
class Feature:
    """A column or camera of the data set."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None  # of its numbers, None where the data set names only the axes
    is_depth: bool

    @property
    def is_camera(self) -> bool:
        return self.dtype in ("video", "image")

    def picture_size(self, place: Path) -> tuple[int, int]:
        """(H, W) of a camera, whose shape has the channels first or last. Raises UserError where it is no colour."""
        height, width, channels = self.shape if len(self.shape) == 3 else (0, 0, 0)
        if self.shape[:1] == (3,) and channels != 3:
            height, width, channels = self.shape[1], self.shape[2], 3
        if channels != 3 or min(height, width) < 1 or self.is_depth:
            found = "depth" if self.is_depth else list(self.shape)
            raise misfit(
                place,
                f"features.{self.key}",
                "pictures of three colours (other ones are not supported)",
                found,
                "choose other cameras in the options",
            )
        return height, width


@dataclass(frozen=True, slots=True)
class Info:
    """What meta/info.json says."""

    path: Path
    fps: float
    num_episodes: int
    features: Mapping[str, Feature]
    data_path: str
    video_path: str | None

    @property
    def root(self) -> Path:
        return self.path.parents[1]

    @property
    def home(self) -> Path:
        return home_of(self.root)

    def data_file(self, chunk: int, file: int) -> Path:
        return inside(self, "data_path", self.data_path, chunk_index=chunk, file_index=file)

    def video_file(self, key: str, chunk: int, file: int) -> Path:
        if self.video_path is None:
            raise misfit(self.path, "video_path", "a text, since there are videos", None, DOWNLOAD)
        return inside(self, "video_path", self.video_path, video_key=key, chunk_index=chunk, file_index=file)


def home_of(root: Path) -> Path:
    """Where files of the data set in `root` may lie: there, or beside it in the Hub's cache, whose files are links."""
    real = Path(os.path.realpath(root))  # unlike `resolve` also of a link that leads to itself
    return real.parents[1] if real.parent.name == "snapshots" else real


def read_info(root: Path) -> Info:
    """The description of the data set in `root`. Raises UserError where it is none, of another version, or damaged."""
    path = root / INFO
    if not path.is_file():
        found = "no such file" if root.is_dir() else "no folder"
        raise UserError(
            f"No LeRobot data set at {root}: wanted {INFO} there, found {found}; correct the path."
        )
    values = read_json(path, DOWNLOAD, mapping=True, home=home_of(root))
    version = str(values.get("codebase_version"))
    if not re.fullmatch(r"v?3(\.\d+)*", version):
        raise misfit(
            path,
            "codebase_version",
            "v3.0 (other versions are not supported)",
            version,
            "convert the data set with LeRobot's own convert_dataset_v21_to_v30",
        )
    fps = values.get("fps")
    if (
        isinstance(fps, bool)
        or not isinstance(fps, int | float)
        or not (math.isfinite(fps) and 0 < fps <= 1e4)
    ):
        raise misfit(path, "fps", "a number above 0", fps, "write the rate of the recording there")
    count = values.get("total_episodes")
    if not (is_whole(count) and 1 <= count <= MAX_EPISODES):
        raise misfit(path, "total_episodes", f"1 to {MAX_EPISODES}", count, DOWNLOAD)
    features = values.get("features")
    if not isinstance(features, dict) or not features:
        raise misfit(path, "features", "a mapping", features, DOWNLOAD)
    for key in ("data_path", "video_path"):
        if values.get(key) is not None and not isinstance(values[key], str):
            raise misfit(path, key, "a text", values[key], DOWNLOAD)
    return Info(
        path=path,
        fps=float(fps),
        num_episodes=count,
        features={key: _feature(path, key, value) for key, value in features.items()},
        data_path=values.get("data_path") or DATA,
        video_path=values.get("video_path"),
    )


def _feature(path: Path, key: str, values: Any) -> Feature:
    shape = values.get("shape") if isinstance(values, dict) else None
    fits = isinstance(shape, list) and len(shape) <= 8 and all(is_whole(n) and n >= 0 for n in shape)
    if not fits or not isinstance(values.get("dtype"), str):
        raise misfit(path, f"features.{key}", "a mapping with dtype and shape", values, DOWNLOAD)
    info = values.get("info") or values.get("video_info") or {}
    depth = [info.get("is_depth_map"), info.get("video.is_depth_map")] if isinstance(info, dict) else []
    names = _names(values.get("names"))
    is_named = (
        names is not None and len(shape) == 1 and len(names) == shape[0] and len(set(names)) == len(names)
    )
    return Feature(key, values["dtype"], tuple(shape), names if is_named else None, any(depth))


def _names(names: Any) -> tuple[str, ...] | None:
    """The names of a feature's numbers: a list, a mapping to lists, or a mapping to places."""
    if isinstance(names, dict):
        if names and all(map(is_whole, names.values())):
            names = sorted(names, key=names.get)
        else:
            names = [name for part in names.values() for name in (part if isinstance(part, list) else [part])]
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        return None
    return tuple(names)


def inside(info: Info, key: str, template: str, **values: str | int) -> Path:
    """The file that a path with holes such as {chunk_index:03d} names.

    The holes are filled here, since a format of Python can reach attributes and state any width. Raises UserError
    where the file is not where `home_of` says.
    """

    def filled(hole: re.Match[str]) -> str:
        if hole.group(1) not in values:
            raise misfit(info.path, key, f"a path with {', '.join(values)}", template, DOWNLOAD)
        value = values[hole.group(1)]
        return f"{value:0{hole.group(2) or 1}d}" if isinstance(value, int) else value

    name = _HOLE.sub(filled, template)
    if re.search(r"[{}\0]", name) or len(name) > 1000:
        raise misfit(info.path, key, f"a path with holes for {', '.join(values)}", template, DOWNLOAD)
    path = info.root / name
    if ".." in Path(name).parts or not Path(os.path.realpath(path)).is_relative_to(info.home):
        raise misfit(
            info.path, key, "a path inside the data set", shortened(name), "use a data set that you trust"
        )
    return path


def dump(value: Any) -> str:
    """JSON as LeRobot writes it."""
    return json.dumps(value, indent=4, ensure_ascii=False) + "\n"
