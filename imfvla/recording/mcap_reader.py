"""Reads recorded episodes back, and refuses those that are not whole."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata

from imfvla.documents import parse_json
from imfvla.episode import EpisodeInfo, EpisodeResult
from imfvla.errors import UserError
from imfvla.recording import messages
from imfvla.recording.mcap_file import MAX_EPISODE_BYTES, clear_read_errors, records
from imfvla.recording.pictures import decode


@dataclass(frozen=True, slots=True)
class Episode:
    """A recorded episode. T control steps, K steps with frames."""

    path: Path
    info: EpisodeInfo
    result: EpisodeResult
    time_s: np.ndarray  # float64 (T,)  simulated, before the action
    state: np.ndarray  # float32 (T, 16)  before the action
    action: np.ndarray  # float32 (T, 16)  clean: what a policy should learn
    executed: np.ndarray  # float32 (T, 16)
    reward: np.ndarray  # float32 (T,)  after the action
    stage: np.ndarray  # int64 (T,)  after the action
    chunks: Mapping[int, np.ndarray]  # step -> float32 (Tp, 16), where the policy replanned
    image_steps: np.ndarray  # int64 (K,)  steps at which every recorded view has a frame
    images: Mapping[str, np.ndarray]  # view -> uint8 (K, H, W, 3); empty if not requested


def read_episode(path: str | Path, *, images: bool | Collection[str] = True) -> Episode:
    """The whole episode at `path`, with every checksum verified.

    `images` says which views to decode: all, none, or those named. Raises UserError naming the file where
    it is missing, truncated or corrupt, and where it lacks a requested view.
    """
    path = Path(path)
    with clear_read_errors(path):
        return _parse(path, path.read_bytes(), images)


def _parse(path: Path, data: bytes, images: bool | Collection[str]) -> Episode:
    topics: dict[int, str] = {}
    rows: dict[str, list[tuple[int, bytes]]] = {}
    metadata: dict[str, dict[str, str]] = {}
    config: dict[str, Any] = {}
    for record in records(data):
        if isinstance(record, Message):
            rows.setdefault(topics[record.channel_id], []).append((record.log_time, record.data))
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        elif isinstance(record, Attachment) and record.name == messages.CONFIG_ATTACHMENT:
            config = parse_json(record.data)  # never extracted, so its name is no path
    for name in messages.RECORDS:
        if name not in metadata:
            raise ValueError(f"no metadata record {name}")
    if (found := metadata[messages.EPISODE_RECORD]["format"]) != messages.FORMAT:
        raise UserError(
            f"{path} has recording format {found}, wanted {messages.FORMAT}: read it with the version of imfvla that "
            "wrote it, or move it away and collect again."
        )
    info = messages.read_info(metadata[messages.EPISODE_RECORD], config)
    result = messages.read_result(metadata[messages.RESULT_RECORD])

    times = [time for time, _ in rows.get(messages.STATE, [])]
    num_steps = int(metadata[messages.RESULT_RECORD]["recorded_steps"])
    for topic in (messages.STATE, messages.ACTION, messages.REWARD):
        if len(rows.get(topic, [])) != num_steps:
            raise ValueError(f"{len(rows.get(topic, []))} messages of {topic} for {num_steps} steps")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"times of {messages.STATE} do not increase")
    step_at = {time: step for step, time in enumerate(times)}

    states = [messages.from_arms(parse_json(text)) for _, text in rows.get(messages.STATE, [])]
    actions = [parse_json(text) for _, text in rows.get(messages.ACTION, [])]
    rewards = [parse_json(text) for _, text in rows.get(messages.REWARD, [])]
    chunks = [parse_json(text) for _, text in rows.get(messages.CHUNK, [])]
    frames = {
        topic.removeprefix(messages.CAMERA): {step_at[time]: text for time, text in row}
        for topic, row in rows.items()
        if topic.startswith(messages.CAMERA)
    }
    image_steps = sorted(set.intersection(*(set(steps) for steps in frames.values()))) if frames else []
    views = (tuple(frames) if images else ()) if isinstance(images, bool) else tuple(images)
    if lacking := [view for view in views if view not in frames]:
        raise UserError(
            f"{path} has no frames of view {', '.join(lacking)}; it has {', '.join(frames) or 'none'}. "
            "Change observation.views, or collect again with these views."
        )
    return Episode(
        path=path,
        info=info,
        result=result,
        time_s=(np.array(times, np.int64) - messages.EPOCH_NS) / 1e9,
        state=_matrix(states),
        action=_matrix([messages.from_arms(action["clean"]) for action in actions]),
        executed=_matrix([messages.from_arms(action["executed"]) for action in actions]),
        reward=np.array([reward["reward"] for reward in rewards], np.float32),
        stage=np.array([reward["stage"] for reward in rewards], np.int64),
        chunks={chunk["step"]: _matrix(chunk["actions"]) for chunk in chunks},
        image_steps=np.array(image_steps, np.int64),
        images={
            view: np.stack(list(_decoded(frames[view][step] for step in image_steps)))
            if image_steps
            else np.zeros((0, *info.image_size, 3), np.uint8)
            for view in views
        },
    )


def _decoded(encoded: Iterable[bytes]) -> Iterator[np.ndarray]:
    total = 0
    for message in encoded:
        picture = decode(messages.camera_bytes(message))
        total += picture.nbytes
        if total > MAX_EPISODE_BYTES:
            raise ValueError(f"pictures of more than {MAX_EPISODE_BYTES} bytes")
        yield picture


def _matrix(rows: list) -> np.ndarray:
    """float32 (len(rows), 16); None becomes NaN."""
    with np.errstate(over="ignore"):  # what is too large for a float32 is infinite
        numbers = np.array(rows, np.float64).astype(np.float32)
    return numbers.reshape(len(rows), len(messages.ACTION_NAMES))
