"""Episodes of any source as memory-mapped arrays, decoded once for all epochs and runs.

Shapes: N frames, V views, H W pixels, T control steps of all episodes, S state, A action.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.data.checksums import checked_sums, digest_of
from imfvla.data.store_format import ARRAYS, FORMAT, IMAGES, StoreMeta, is_made_from, meta_of
from imfvla.data.store_writing import Progress, write_store
from imfvla.errors import UserError
from imfvla.robot import MAX_CHANNELS
from imfvla.sources.base import EpisodeSource
from imfvla.storage.files import clear_folder, locked
from imfvla.storage.opening import ARRAY, checked
from imfvla.storage.records import read_record

MAX_NPY_HEADER = 4096  # bytes, of an array's shape and type


@dataclass(frozen=True, slots=True)
class StoredEpisode:
    """Where an episode lies in the store's arrays."""

    name: str
    task: str
    instructions: tuple[str, ...]  # the recorded sentence, then its paraphrases
    num_steps: int
    first_row: int  # of state and action
    first_frame: int  # of images
    image_steps: np.ndarray  # int64 (K,)  steps of its frames, within the episode
    skipped: tuple[
        tuple[int, int], ...
    ] = ()  # [first, end) of the steps that are not to be imitated, ascending

    @property
    def learned(self) -> tuple[tuple[int, int], ...]:
        """[first, end) of the other steps, ascending."""
        edges = [0, *(step for span in self.skipped for step in span), self.num_steps]
        spans = zip(edges[::2], edges[1::2], strict=True)
        return tuple((first, end) for first, end in spans if first < end)


@dataclass(frozen=True, slots=True)
class FrameStore:
    """Arrays of all episodes, one after the other, in the order of their source."""

    path: Path
    views: tuple[str, ...]
    image_size: tuple[int, int]  # (H, W) [px]
    episodes: tuple[StoredEpisode, ...]
    images: np.ndarray  # uint8 (N, V, 3, H, W), memory-mapped; channels first, as batches want them
    image_steps: np.ndarray  # int64 (N,)  step of each frame within its episode, memory-mapped
    state: np.ndarray  # float32 (T, S), memory-mapped
    action: np.ndarray  # float32 (T, A)  clean, memory-mapped
    content: Mapping[
        str, str
    ]  # what is trained on: a digest of each array, of the episodes and of their source

    @classmethod
    def open(cls, path: str | Path) -> "FrameStore":
        """The store that `build` wrote to `path`, whose arrays are compared with their checksums once a process.

        Raises UserError where there is none or it is damaged, naming file and block.
        """
        path = Path(path)
        try:
            meta = read_record(path / "meta.json", StoreMeta, "delete the store")
            if meta["format"] != FORMAT:
                raise ValueError(f"format {meta['format']}, wanted {FORMAT}")
            _check_sizes(path, meta)  # before files of terabytes are read
            sums = checked_sums(path, meta, ARRAYS)
            content = {name: digest_of(sums[name]) for name in ARRAYS}
            content |= {"episodes": _digest_of_episodes(meta), "demonstrations": str(meta["digest"])}
            image_steps = _load(path / "image_steps.npy")
            state, action = _load(path / "state.npy"), _load(path / "action.npy")
            shape = (len(image_steps), len(meta["views"]), 3, *meta["image_size"])
            images = _mapped(path / IMAGES, np.uint8, shape)
            episodes, row, frame = [], 0, 0
            known: dict[tuple[str, ...], tuple[str, ...]] = {}  # thousands of episodes share their sentences
            for entry in meta["episodes"]:
                steps = image_steps[frame : frame + entry.pop("num_frames")]
                entry["skipped"] = tuple(map(tuple, entry.get("skipped", ())))
                instructions = tuple(entry["instructions"])
                entry["instructions"] = known.setdefault(instructions, instructions)
                episodes.append(StoredEpisode(first_row=row, first_frame=frame, image_steps=steps, **entry))
                row, frame = row + entry["num_steps"], frame + len(steps)
            if not len(state) == len(action) == row or len(image_steps) != frame:
                raise ValueError("its arrays differ in length")
            _check_arrays(state, action, image_steps, episodes)
            _check_skipped(episodes)
        except Exception as error:  # a damaged byte can raise anything
            raise UserError(
                f"Frame store {path} cannot be read ({error}): delete it, or choose another folder with "
                "demos.frames_directory, and run again."
            ) from error
        views, image_size = tuple(meta["views"]), tuple(meta["image_size"])
        return cls(path, views, image_size, tuple(episodes), images, image_steps, state, action, content)

    @staticmethod
    def is_current(
        source: EpisodeSource, store_path: str | Path, image_size: Sequence[int], views: Sequence[str]
    ) -> bool:
        """Whether `build` would keep what is at `store_path`, whose episodes it has checked."""
        return is_made_from(Path(store_path), meta_of(source, tuple(views), tuple(image_size)))

    @classmethod
    def build(
        cls,
        source: EpisodeSource,
        store_path: str | Path,
        image_size: Sequence[int],
        views: Sequence[str],
        *,
        progress: Progress | None = None,
    ) -> "FrameStore":
        """The store of these episodes; an existing one is kept while it is up to date.

        It is out of date once the source's digest, views or image size differ. Episodes are decoded a few at a time,
        so memory stays low; frames of another size are resampled. Raises UserError where episodes are
        missing, damaged or without a view, where nothing can be written, and where something else is at
        `store_path`; an existing store is only replaced by a complete one. Concurrent builds wait for
        each other.
        """
        store_path = Path(store_path)
        for view in views:
            source.robot.camera(view)
        meta = meta_of(source, tuple(views), tuple(image_size))
        with locked(store_path):
            clear_folder(store_path)
            if not is_made_from(store_path, meta):
                write_store(source, store_path, meta, progress or (lambda done, total: None))
            return cls.open(store_path)


def _check_sizes(path: Path, meta: Mapping[str, Any]) -> None:
    """Raises ValueError where a file is larger than the episodes of meta.json allow."""
    rows, frames = (sum(entry[key] for entry in meta["episodes"]) for key in ("num_steps", "num_frames"))
    numbers = MAX_NPY_HEADER + rows * MAX_CHANNELS * np.dtype(np.float32).itemsize
    most = {
        IMAGES: frames * len(meta["views"]) * 3 * math.prod(meta["image_size"]),
        "image_steps.npy": MAX_NPY_HEADER + frames * np.dtype(np.int64).itemsize,
        "state.npy": numbers,
        "action.npy": numbers,
    }
    for name, size in most.items():
        if (found := (path / name).stat().st_size) > size:
            raise ValueError(f"{name} has {found} bytes, wanted at most {size}")


def _check_arrays(
    state: np.ndarray, action: np.ndarray, image_steps: np.ndarray, episodes: Sequence[StoredEpisode]
) -> None:
    """Raises ValueError where arrays are not of the types that `build` writes, or have frames of no step."""
    for name, array, kind, dimensions in (
        ("state", state, np.float32, 2),
        ("action", action, np.float32, 2),
        ("image_steps", image_steps, np.int64, 1),
    ):
        if array.dtype != kind or array.ndim != dimensions:
            raise ValueError(f"{name} is {array.dtype} of shape {array.shape}")
    lengths = np.repeat([e.num_steps for e in episodes], [len(e.image_steps) for e in episodes])
    if (image_steps < 0).any() or (image_steps >= lengths).any():
        raise ValueError("image_steps are not all of its episodes' steps")


def _check_skipped(episodes: Sequence[StoredEpisode]) -> None:
    """Raises ValueError where steps that are not to be imitated are not in order, or not of their episode."""
    for episode in episodes:
        edges = [step for span in episode.skipped for step in span]
        if edges != sorted(set(edges)) or (edges and edges[-1] > episode.num_steps):
            raise ValueError(f"{episode.name} skips {episode.skipped} of {episode.num_steps} steps")


def _digest_of_episodes(meta: Mapping[str, Any]) -> str:
    """Of what a training takes from meta.json: not the names, which only messages need."""
    entries = [{key: entry[key] for key in entry if key != "name"} for entry in meta["episodes"]]
    return digest_of([meta["views"], meta["image_size"], entries])


def _load(path: Path) -> np.ndarray:
    """Memory-mapped: all processes share it. Raises ValueError where its file has another size than it states."""
    array = np.load(checked(path, ARRAY), mmap_mode="r", allow_pickle=False)
    if not isinstance(array, np.memmap) or path.stat().st_size != array.offset + array.nbytes:
        raise ValueError(f"{path.name} has {path.stat().st_size} bytes, wanted another number")
    return np.asarray(array)


def _mapped(path: Path, kind: type, shape: tuple[int, ...]) -> np.ndarray:
    """The same for a file without a header."""
    size, wanted = path.stat().st_size, math.prod(shape) * np.dtype(kind).itemsize
    if size != wanted:
        raise ValueError(f"{path.name} has {size} bytes, wanted {wanted}")
    return np.asarray(np.memmap(checked(path, ARRAY), kind, "r", shape=shape))
