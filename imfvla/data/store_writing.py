"""Writes a frame store: episodes that threads decode, into a folder that appears whole or not at all.

Shapes: K frames of an episode, V views, H W pixels.
"""

import json
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.data.checksums import remember, with_checksums
from imfvla.data.resample import resample
from imfvla.data.store_format import ARRAYS, FILES, IMAGES
from imfvla.errors import UserError
from imfvla.sources.base import EpisodeArrays, EpisodeSource
from imfvla.sources.validation import check_episode
from imfvla.storage.files import make_folder, put_folder, write_remedy

NUM_DECODERS = 2  # threads: decompression, decoding and checksums run outside the interpreter lock

Progress = Callable[[int, int], None]  # called with (episodes done, episodes in all)


def write_store(source: EpisodeSource, store_path: Path, meta: dict[str, Any], progress: Progress) -> None:
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
            if episode.imitate is not None and not episode.imitate.all():
                entry["skipped"] = spans_without(episode.imitate)
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


def spans_without(flags: np.ndarray) -> list[list[int]]:
    """[first, end) of each run of false in flags, bool (T,)."""
    changes = np.flatnonzero(np.diff(flags, prepend=True, append=True))
    return changes.reshape(-1, 2).tolist()


def _save(path: Path, array: np.ndarray) -> None:
    np.save(path, array, allow_pickle=False)


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
