"""What a frame store is on disk: its files, its `meta.json`, and what it is made from."""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from imfvla.errors import UserError
from imfvla.options import at_most, of_length, within, within_length
from imfvla.robot import MAX_CAMERAS, MAX_SIDE
from imfvla.sources.base import EpisodeSource
from imfvla.storage.documents import read_json

FORMAT = 2
IMAGES = "images.raw"
ARRAYS = (IMAGES, "image_steps.npy", "state.npy", "action.npy")
FILES = {*ARRAYS, "meta.json"}


class EpisodeEntry(TypedDict):
    """An episode in `meta.json`."""

    name: str
    task: str
    instructions: Annotated[list[Annotated[str, at_most(10_000)]], within_length(1, 10_000)]
    num_steps: Annotated[int, within(1, 10**7)]
    num_frames: Annotated[int, within(0, 10**7)]
    # [first, end) of the steps that are not to be imitated, ascending; absent where there are none
    skipped: NotRequired[list[Annotated[list[Annotated[int, within(0, 10**7)]], of_length(2)]]]


class StoreMeta(TypedDict):
    """`meta.json`."""

    format: int
    digest: str
    views: Annotated[list[str], within_length(1, MAX_CAMERAS)]
    image_size: Annotated[list[Annotated[int, within(1, MAX_SIDE)]], of_length(2)]
    episodes: list[EpisodeEntry]


def meta_of(source: EpisodeSource, views: tuple[str, ...], image_size: tuple[int, int]) -> dict[str, Any]:
    """What a store is made from, as in its meta.json; the digest shows whether the store is up to date."""
    content = json.dumps([FORMAT, views, image_size, source.digest()])
    return {
        "format": FORMAT,
        "digest": hashlib.sha256(content.encode()).hexdigest(),
        "views": list(views),
        "image_size": list(image_size),
    }


def is_made_from(store_path: Path, meta: dict[str, Any]) -> bool:
    """Whether a store at `store_path` is of this `meta_of`."""
    try:
        return read_json(store_path / "meta.json", "", mapping=True).get("digest") == meta["digest"]
    except UserError:
        return False
