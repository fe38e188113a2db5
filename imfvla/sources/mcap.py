"""Recordings of this project as a source of episodes: a folder of MCAP files, or those that a collection chose."""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from imfvla.episode import EpisodeInfo
from imfvla.errors import UserError
from imfvla.options import Limit, build
from imfvla.recording import EpisodeIndex, Recordings, read_episode, read_index
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.same_robot import refuse_other_robot


@dataclass(frozen=True, slots=True)
class McapOptions:
    """conf/demos/mcap.yaml, without what all sources share."""

    path: Annotated[str, Limit("a text that is not empty", bool)]


def open_source(options: Mapping[str, Any], *, where: str = "demos") -> "McapSource":
    """All recordings of `options["path"]`, in the order of their names.

    Raises UserError where there are none, or where the first is damaged.
    """
    return McapSource.of(build(McapOptions, options, where).path)


class McapSource:
    """An `EpisodeSource` of recorded episodes. All are of the robot of the first one."""

    def __init__(self, recordings: Recordings) -> None:
        self.recordings = recordings
        self.robot = self._index(0).info.robot

    @classmethod
    def of(cls, directory: str | Path) -> "McapSource":
        """All recordings of a folder, in the order of their names. Raises UserError where there are none."""
        return cls(Recordings.of(directory))

    def __len__(self) -> int:
        return len(self.recordings.files)

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        """See `EpisodeSource`. Verifies every checksum of the file."""
        episode = read_episode(self.recordings.files[index], images=tuple(views))
        first, path = self.recordings.files[0], episode.path
        refuse_other_robot(
            self.robot,
            episode.info.robot,
            views,
            of=f"recording {first}",
            where=f"Recording {path}",
            remedy="Keep recordings of different robots in different folders.",
        )
        return EpisodeArrays(
            name=path.name,
            task=episode.info.task,
            instructions=(episode.info.instruction, *_paraphrases(episode.info)),
            state=episode.state,
            action=episode.action,
            image_steps=episode.image_steps,
            images=episode.images,
            imitate=episode.imitate,
        )

    def num_frames(self, index: int) -> int:
        """See `EpisodeSource`."""
        return max(self._index(index).num_frames.values(), default=0)

    def digest(self) -> str:
        """Of names, sizes and checksums of the files."""
        digest = hashlib.sha256()
        for number, file in enumerate(self.recordings.files):
            index = self._index(number)
            digest.update(json.dumps([file.name, index.num_bytes, index.data_crc]).encode())
        return digest.hexdigest()

    def _index(self, number: int) -> EpisodeIndex:
        if number not in self._indices:
            self._indices[number] = read_index(self.recordings.files[number])
        return self._indices[number]

    @cached_property
    def _indices(self) -> dict[int, EpisodeIndex]:
        return {}


def _paraphrases(info: EpisodeInfo) -> Sequence[str]:
    """Recorded beside the sentence. Raises UserError where they are no texts, which JSON does not guarantee."""
    found = info.metadata.get("paraphrases", ())
    if not isinstance(found, list | tuple) or not all(isinstance(text, str) for text in found):
        raise UserError(f"paraphrases must be a list of texts, found {found!r}: record the episode again.")
    return found
