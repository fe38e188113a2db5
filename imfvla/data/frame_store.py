"""Episodes of any source as memory-mapped arrays, decoded once for all epochs and runs.

Shapes: N frames, V views, H W pixels, T control steps of all episodes, S state, A action.
"""

import hashlib
import json
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np

from imfvla.data.checksums import checked_sums, digest_of, remember, with_checksums
from imfvla.data.resample import resample
from imfvla.errors import UserError
from imfvla.options import at_most, of_length, within, within_length
from imfvla.robot import MAX_CAMERAS, MAX_CHANNELS, MAX_SIDE
from imfvla.sources.base import EpisodeArrays, EpisodeSource
from imfvla.sources.validation import check_episode
from imfvla.storage.documents import read_json
from imfvla.storage.files import clear_folder, locked, make_folder, put_folder, write_remedy
from imfvla.storage.opening import ARRAY, checked
from imfvla.storage.records import read_record

FORMAT = 2
IMAGES = "images.raw"
MAX_NPY_HEADER = 4096  # bytes, of an array's shape and type
ARRAYS = (IMAGES, "image_steps.npy", "state.npy", "action.npy")
FILES = {*ARRAYS, "meta.json"}
NUM_DECODERS = 2  # threads: decompression, decoding and checksums run outside the interpreter lock

Progress = Callable[[int, int], None]  # called with (episodes done, episodes in all)


class EpisodeEntry(TypedDict):
    """An episode in `meta.json`."""

    name: str
    task: str
    instructions: Annotated[list[Annotated[str, at_most(10_000)]], within_length(1, 10_000)]
    num_steps: Annotated[int, within(1, 10**7)]
    num_frames: Annotated[int, within(0, 10**7)]


class StoreMeta(TypedDict):
    """`meta.json`."""

    format: int
    digest: str
    views: Annotated[list[str], within_length(1, MAX_CAMERAS)]
    image_size: Annotated[list[Annotated[int, within(1, MAX_SIDE)]], of_length(2)]
    episodes: list[EpisodeEntry]


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
                instructions = tuple(entry["instructions"])
                entry["instructions"] = known.setdefault(instructions, instructions)
                episodes.append(StoredEpisode(first_row=row, first_frame=frame, image_steps=steps, **entry))
                row, frame = row + entry["num_steps"], frame + len(steps)
            if not len(state) == len(action) == row or len(image_steps) != frame:
                raise ValueError("its arrays differ in length")
            _check_arrays(state, action, image_steps, episodes)
        except Exception as error:  # a damaged byte can raise anything
            raise UserError(
                f"Frame store {path} cannot be read ({error}): delete it, or choose another folder with "
                "demos.frames_directory, and run again."
            ) from error
        views, image_size = tuple(meta["views"]), tuple(meta["image_size"])
        return cls(path, views, image_size, tuple(episodes), images, image_steps, state, action, content)

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
            if not _is_current(store_path, meta):
                _write(source, store_path, meta, progress or (lambda done, total: None))
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


def meta_of(source: EpisodeSource, views: tuple[str, ...], image_size: tuple[int, int]) -> dict[str, Any]:
    """What a store is made from, as in its meta.json; the digest shows whether the store is up to date."""
    content = json.dumps([FORMAT, views, image_size, source.digest()])
    return {
        "format": FORMAT,
        "digest": hashlib.sha256(content.encode()).hexdigest(),
        "views": list(views),
        "image_size": list(image_size),
    }


def _digest_of_episodes(meta: Mapping[str, Any]) -> str:
    """Of what a training takes from meta.json: not the names, which only messages need."""
    entries = [{key: entry[key] for key in entry if key != "name"} for entry in meta["episodes"]]
    return digest_of([meta["views"], meta["image_size"], entries])


def _is_current(store_path: Path, meta: dict[str, Any]) -> bool:
    try:
        return read_json(store_path / "meta.json", "", mapping=True).get("digest") == meta["digest"]
    except UserError:
        return False


def _write(source: EpisodeSource, store_path: Path, meta: dict[str, Any], progress: Progress) -> None:
    """Writes a complete store beside `store_path` and moves it there."""
    if store_path.exists() and not (store_path.is_dir() and _names(store_path) <= FILES):
        raise UserError(
            f"{store_path} is the place of decoded frames, but is not a frame store: move it away, or choose another "
            "folder with demos.frames_directory."
        )
    part = store_path.with_name(f".{store_path.name}.part")
    needed = _num_frames(source, meta["views"]) * len(meta["views"]) * 3 * math.prod(meta["image_size"])
    try:
        make_folder(store_path.parent)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        if (free := shutil.disk_usage(part).free) < needed:
            raise UserError(
                f"Frame store {store_path} needs {needed / 1e9:.1f} GB, found {free / 1e9:.1f} GB free: free disk "
                "space, choose another disk with demos.frames_directory, or lower observation.image_size or the "
                "number of views."
            )
        written = _write_arrays(source, part, meta, progress)
        put_folder(part, store_path)
        remember(store_path, written, ARRAYS)
    except OSError as error:
        raise UserError(
            f"Cannot write frame store {store_path}: {error.strerror or error}; choose another folder with "
            f"demos.frames_directory, or {write_remedy(error)}."
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _names(store_path: Path) -> set[str]:
    """The files of a store, without those that NFS and FUSE keep while a process has them open."""
    return {name for name in os.listdir(store_path) if not name.startswith((".nfs", ".fuse_hidden"))}


def _num_frames(source: EpisodeSource, views: Sequence[str]) -> int:
    """Frames of each view. Raises UserError where there are none."""
    found = sum(source.num_frames(index) for index in range(len(source)))
    if found == 0:
        raise UserError(
            f"The {len(source)} episodes of demos have no frames of {', '.join(views)}: change observation.views, or "
            "collect again with these views."
        )
    return found


def _write_arrays(
    source: EpisodeSource, part: Path, meta: dict[str, Any], progress: Progress
) -> dict[str, Any]:
    """Fills the folder `part`; returns the content of its meta.json."""
    entries, steps, states, actions = [], [], [], []
    with open(part / IMAGES, "wb") as stream:
        for episode, frames in _decoded(source, meta["views"], meta["image_size"]):
            stream.write(frames)
            entry = {
                "name": episode.name,
                "task": episode.task,
                "instructions": list(episode.instructions),
                "num_steps": len(episode.state),
                "num_frames": len(episode.image_steps),
            }
            entries.append(entry)
            steps.append(episode.image_steps)
            states.append(episode.state)
            actions.append(episode.action)
            progress(len(entries), len(source))
    _save(part / "image_steps.npy", np.concatenate(steps))
    _save(part / "state.npy", np.concatenate(states))
    _save(part / "action.npy", np.concatenate(actions))
    meta = with_checksums(meta | {"episodes": entries}, part, ARRAYS)
    (part / "meta.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")
    return meta


def _save(path: Path, array: np.ndarray) -> None:
    np.save(path, array, allow_pickle=False)


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


def _decoded(
    source: EpisodeSource, views: Sequence[str], image_size: Sequence[int]
) -> Iterator[tuple[EpisodeArrays, np.ndarray]]:
    """Episodes in order with their frames, decoded by threads that stay a few episodes ahead."""
    ahead: deque[Future[tuple[EpisodeArrays, np.ndarray]]] = deque()
    with ThreadPoolExecutor(NUM_DECODERS) as threads:
        for index in range(len(source)):
            ahead.append(threads.submit(_decode, source, index, views, image_size))
            if len(ahead) > 2 * NUM_DECODERS:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def _decode(
    source: EpisodeSource, index: int, views: Sequence[str], image_size: Sequence[int]
) -> tuple[EpisodeArrays, np.ndarray]:
    """The episode and its frames: contiguous uint8 (K, V, 3, H, W)."""
    episode = source.episode(index, views)
    check_episode(episode, source.robot, views)
    frames = np.empty((len(episode.image_steps), len(views), 3, *image_size), np.uint8)
    for number, view in enumerate(views):
        for frame, picture in zip(frames[:, number], episode.images[view], strict=True):
            frame[...] = resample(picture, image_size).transpose(2, 0, 1)
    return replace(episode, images={}), frames
