"""Episodes in robomimic's and ACT's HDF5 files. Shapes: T control steps, K steps with frames, S state, A action."""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import h5py
import numpy as np

from imfvla.errors import UserError
from imfvla.options import Limit, above, at_least, build, one_of, within
from imfvla.robot import MAX_CONTROL_HZ, Camera, RobotSpec
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.checks import (
    MAX_EPISODES,
    SENTENCE,
    action_range,
    channels,
    chosen_episodes,
    digest_of,
    displaced,
    documented,
    misfit,
    refuse_repeated,
    shortened,
)
from imfvla.sources.hdf5.file import (
    dataset,
    group,
    is_pictures,
    numbers_shape,
    opened,
    picture_size,
    read_numbers,
    read_pictures,
)
from imfvla.storage.opening import real_path

SUFFIXES = (".hdf5", ".h5")


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a project's files keep an episode, within the group of the episode."""

    episodes: str | None  # group with a group for each episode; None: a file is an episode
    state: str
    cameras: str
    action: str


LAYOUTS = {
    "robomimic": Layout("data", "obs", "obs", "actions"),
    "act": Layout(None, "observations", "observations/images", "action"),
}


@dataclass(frozen=True, slots=True)
class Options:
    """What conf/demos/hdf5.yaml documents."""

    path: Annotated[str, Limit("a path", bool)]
    layout: Annotated[str, one_of(*LAYOUTS)]
    episodes: tuple[Annotated[int, at_least(0)], ...] | None
    control_hz: Annotated[float, above(0), within(0, MAX_CONTROL_HZ)]
    state: Any  # key -> names of channels
    action: tuple[str, ...]
    action_key: str | None
    cameras: Mapping[str, str] | None  # view -> key
    picture_order: Annotated[str, one_of("rgb", "bgr")]
    absolute: tuple[str, ...] | None
    action_min: tuple[float, ...] | None
    action_max: tuple[float, ...] | None
    camera_every: Annotated[int, at_least(1)]
    instruction: Annotated[str, SENTENCE]


class Hdf5Source:
    """An `EpisodeSource` on a file or a folder of files; each call opens its file itself."""

    robot: RobotSpec

    def __init__(self, options: Options, where: str) -> None:
        self._options, self._where, self._layout = options, where, LAYOUTS[options.layout]
        self._state = _state(options.state, f"{where}.state")
        self._action = channels(options.action, f"{where}.action", need_units=True)
        self._files = _files(Path(options.path), where)
        places = list(self._places())
        self._places_chosen = [
            places[number] for number in chosen_episodes(options.episodes, len(places), options.path, where)
        ]
        names = tuple(name for part in self._state.values() for name in part)
        refuse_repeated(names, f"{where}.state")
        self._cameras, sizes = self._chosen_cameras()
        self._lengths, seen = self._surveyed()
        stated = (options.action_min, options.action_max)
        low, high = action_range(self._action, stated, seen, where)
        self.robot = RobotSpec(
            names,
            self._action,
            displaced(names, self._action, options.absolute, where),
            low,
            high,
            options.control_hz,
            tuple(Camera(view, *size) for view, size in sizes.items()),
        )

    def __len__(self) -> int:
        return len(self._places_chosen)

    def num_frames(self, index: int) -> int:
        return -(-self._lengths[index] // self._options.camera_every) if self._cameras else 0

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        path, name = self._places_chosen[index]
        options, layout = self._options, self._layout
        with opened(path) as file:
            parent = _episode_group(file, name, path)
            action = read_numbers(self._action_data(parent, path), self._action, path)
            parts = []
            for key, names in self._state.items():
                data = dataset(parent, f"{layout.state}/{key}", path)
                _same_length(data, len(action), path)
                parts.append(read_numbers(data, names, path))
            images = {}
            for view in views:
                camera = self.robot.camera(view)
                data = dataset(parent, f"{layout.cameras}/{self._cameras[view]}", path)
                _same_length(data, len(action), path)
                size = (camera.height, camera.width)
                images[view] = read_pictures(
                    data, options.camera_every, size, options.picture_order == "bgr", path
                )
        return EpisodeArrays(
            name=path.stem if name is None else f"{path.stem}/{name}",
            task=options.instruction,
            instructions=(options.instruction,),
            state=np.concatenate(parts, 1),
            action=action,
            image_steps=np.arange(0, len(action) if self._cameras else 0, options.camera_every),
            images=images,
        )

    def digest(self) -> str:
        """Of the sizes and times of change of the files, and of the options."""
        options = {key: value for key, value in asdict(self._options).items() if key != "path"}
        return digest_of(self._files[0].parent, self._files, [options, self.robot.to_json()])

    def _places(self) -> Iterator[tuple[Path, str | None]]:
        """File and group of each episode, in the order of their numbers."""
        for path in self._files:
            if self._layout.episodes is None:
                yield path, None
                continue
            with opened(path) as file:
                parent = group(file, self._layout.episodes, path)
                if not 1 <= len(parent) <= MAX_EPISODES:
                    raise misfit(
                        path, self._layout.episodes, f"a group of 1 to {MAX_EPISODES} episodes", len(parent),
                        f"correct {self._where}.layout or the path",
                    )  # fmt: skip
                names = sorted(parent, key=_natural)
            yield from ((path, f"{self._layout.episodes}/{name}") for name in names)

    def _chosen_cameras(self) -> tuple[dict[str, str], dict[str, tuple[int, int]]]:
        """View -> key, and view -> (H, W) in the first episode: those of the options, else all that look like one."""
        path, name = self._places_chosen[0]
        views = self._options.cameras
        with opened(path) as file:
            parent = _episode_group(file, name, path)
            if views is None:
                views = {key: key for key in self._like_cameras(parent, path)}
            data = {
                view: dataset(parent, f"{self._layout.cameras}/{key}", path) for view, key in views.items()
            }
            return dict(views), {view: picture_size(found, path) for view, found in data.items()}

    def _like_cameras(self, parent: h5py.Group, path: Path) -> list[str]:
        """Keys of the pictures of an episode; ACT's may have no cameras at all."""
        for number, part in enumerate(parts := self._layout.cameras.split("/")):
            if part not in (group(parent, "/".join(parts[:number]), path) if number else parent):
                return []
        folder = group(parent, self._layout.cameras, path)
        keys = [key for key in sorted(folder) if isinstance(folder.get(key, getlink=True), h5py.HardLink)]
        data = {key: folder[key] for key in keys if isinstance(folder[key], h5py.Dataset)}
        # Beside robomimic's cameras lie its numbers, and two dimensions may be either.
        dimensions = (1, 2, 4) if self._layout.cameras != self._layout.state else (4,)
        return [key for key, found in data.items() if found.ndim in dimensions and is_pictures(found)]

    def _surveyed(self) -> tuple[list[int], tuple[np.ndarray, np.ndarray]]:
        """Steps of each episode, and the range of all actions, which are read only where no options state it.

        Raises UserError where an episode lacks a key, or has another shape or length there.
        """
        lengths, lows, highs = [], [np.full(len(self._action), np.inf)], [np.full(len(self._action), -np.inf)]
        is_stated = None not in (self._options.action_min, self._options.action_max)
        for path, name in self._places_chosen:
            with opened(path) as file:
                parent = _episode_group(file, name, path)
                data = self._action_data(parent, path)
                numbers_shape(data, self._action, path)
                for key, names in self._state.items():
                    state = dataset(parent, f"{self._layout.state}/{key}", path)
                    numbers_shape(state, names, path)
                    _same_length(state, len(data), path)
                for key in self._cameras.values():
                    _same_length(dataset(parent, f"{self._layout.cameras}/{key}", path), len(data), path)
                if not is_stated or not lengths:
                    action = read_numbers(data, self._action, path)
                    lows.append(action.min(0))
                    highs.append(action.max(0))
                lengths.append(len(data))
        return lengths, (np.min(lows, 0), np.max(highs, 0))

    def _action_data(self, parent: h5py.Group, path: Path) -> h5py.Dataset:
        return dataset(parent, self._options.action_key or self._layout.action, path)


def _files(path: Path, where: str) -> list[Path]:
    if path.is_file():
        return [path]
    found = [file for file in path.glob("*") if file.suffix in SUFFIXES] if path.is_dir() else []
    if not found:
        raise UserError(
            f"{where}.path must be an HDF5 file or a folder of them (*.hdf5, *.h5), found none at {path}: correct it."
        )
    for file in found:
        real_path(file)
    return sorted(found, key=lambda file: _natural(file.name))


def _natural(name: str) -> list[tuple[int, str]]:
    """demo_2 before demo_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _state(parts: Any, key: str) -> dict[str, tuple[str, ...]]:
    fits = isinstance(parts, Mapping) and parts
    fits = fits and all(isinstance(names, list | tuple) and names for names in parts.values())
    if not fits or not all(isinstance(name, str) for names in parts.values() for name in names):
        raise UserError(
            f"{key} must be a mapping of keys to names of channels, found {shortened(parts)}: an HDF5 file has none, "
            f"{documented('hdf5')}."
        )
    return {str(name): channels(names, f"{key}.{name}", need_units=True) for name, names in parts.items()}


def _episode_group(file: h5py.File, name: str | None, path: Path) -> h5py.Group:
    return file if name is None else group(file, name, path)


def _same_length(data: h5py.Dataset, wanted: int, path: Path) -> None:
    found = data.shape[:1]
    if found != (wanted,):
        raise misfit(
            path, data.name, f"of {wanted} steps, as the actions are", found, "leave this episode out"
        )


def open_source(options: Mapping[str, Any], *, where: str = "demos") -> Hdf5Source:
    """The episodes of HDF5 files, as `conf/demos/hdf5.yaml` documents; `where` heads every message.

    Raises UserError naming file or key where the options or a file are not as they must be.
    """
    return Hdf5Source(build(Options, options, where), where)
