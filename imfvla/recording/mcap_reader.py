"""Reads recorded episodes back, and refuses those that are not whole or do not fit their robot."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata

from imfvla.episode import EpisodeInfo, EpisodeResult
from imfvla.errors import UserError
from imfvla.recording import messages
from imfvla.recording.channels import NUMBERS, Channels, Misfit
from imfvla.recording.mcap_file import MAX_EPISODE_BYTES, clear_read_errors, records
from imfvla.recording.pictures import decode, size_of
from imfvla.robot import Camera
from imfvla.storage.documents import parse_json
from imfvla.storage.opening import RECORDING, open_to_read


@dataclass(frozen=True, slots=True)
class Episode:
    """A recorded episode. T control steps, K steps with frames, S state, A action, of `info.robot`."""

    path: Path
    info: EpisodeInfo
    result: EpisodeResult
    time_s: np.ndarray  # float64 (T,)  simulated, before the action
    state: np.ndarray  # float32 (T, S)  before the action
    action: np.ndarray  # float32 (T, A)  clean: what a policy should learn
    executed: np.ndarray  # float32 (T, A)
    imitate: (
        np.ndarray | None
    )  # bool (T,)  whether a policy should learn the action; None: it should learn all
    reward: np.ndarray  # float32 (T,)  after the action
    stage: np.ndarray  # int64 (T,)  after the action
    chunks: Mapping[int, np.ndarray]  # step -> float32 (Tp, A), where the policy replanned
    image_steps: np.ndarray  # int64 (K,)  steps at which every recorded view has a frame
    images: Mapping[str, np.ndarray]  # view -> uint8 (K, H, W, 3) of its camera; empty if not requested


def read_episode(path: str | Path, *, images: bool | Collection[str] = True) -> Episode:
    """The whole episode at `path`, with every checksum verified.

    `images` says which views to decode: all, none, or those named. Raises UserError naming the file where
    it is missing, truncated or corrupt, where it lacks a requested view, and where a message or a picture is not one of
    the robot's.
    """
    path = Path(path)
    with clear_read_errors(path):
        with open_to_read(path, RECORDING) as stream:
            data = stream.read()
        return _parse(path, data, images)


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
    messages.require_records(metadata)
    info = messages.read_info(metadata[messages.EPISODE_RECORD], config, path)
    result = messages.read_result(metadata[messages.RESULT_RECORD], path)

    times = [time for time, _ in rows.get(messages.STATE, [])]
    num_steps = int(metadata[messages.RESULT_RECORD]["recorded_steps"])
    for topic in (messages.STATE, messages.ACTION, messages.REWARD):
        if len(rows.get(topic, [])) != num_steps:
            raise ValueError(f"{len(rows.get(topic, []))} messages of {topic} for {num_steps} steps")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"times of {messages.STATE} do not increase")
    step_at = {time: step for step, time in enumerate(times)}

    state, action = Channels(info.robot.state), Channels(info.robot.action)
    states = _channels(path, messages.STATE, rows, state)
    actions = {
        part: _channels(path, messages.ACTION, rows, action, part)
        for part in (messages.CLEAN, messages.EXECUTED)
    }
    imitate = [parse_json(text)["imitate"] for _, text in rows.get(messages.IMITATE, [])]
    if len(imitate) not in (0, num_steps) or any(type(said) is not bool for said in imitate):
        raise ValueError(
            f"{len(imitate)} messages of {messages.IMITATE} for {num_steps} steps, or one without a flag"
        )
    rewards = [parse_json(text) for _, text in rows.get(messages.REWARD, [])]
    _check_kinds("reward", [reward["reward"] for reward in rewards], NUMBERS)
    _check_kinds("stage", [reward["stage"] for reward in rewards], (int,))
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
        state=states,
        action=actions[messages.CLEAN],
        executed=actions[messages.EXECUTED],
        imitate=np.array(imitate) if imitate else None,
        reward=np.array([reward["reward"] for reward in rewards], np.float32),
        stage=np.array([reward["stage"] for reward in rewards], np.int64),
        chunks={chunk["step"]: _chunk(path, chunk, action) for chunk in chunks},
        image_steps=np.array(image_steps, np.int64),
        images={
            view: _pictures(path, info.robot.camera(view), [frames[view][step] for step in image_steps])
            for view in views
        },
    )


def _channels(
    path: Path, topic: str, rows: Mapping[str, list[tuple[int, bytes]]], channels: Channels, part: str = ""
) -> np.ndarray:
    """The messages of a topic, or a part of each: float32 (T, channels)."""
    found = []
    for step, (_, text) in enumerate(rows.get(topic, [])):
        message = parse_json(text)
        try:
            found.append(channels.values(message[part] if part else message))
        except Misfit as error:
            raise _misfit(path, f"{topic} {part}".strip(), step, error) from error
    return _matrix(found, len(channels.names))


def _chunk(path: Path, chunk: Mapping[str, Any], channels: Channels) -> np.ndarray:
    """float32 (Tp, A)."""
    actions = chunk["actions"]
    _check_kinds("chunk", [number for action in actions for number in action], NUMBERS)
    if any(len(action) != len(channels.names) for action in actions):
        problem = Misfit("each action", f"{len(channels.names)} numbers", f"{[len(a) for a in actions][:5]}")
        raise _misfit(path, messages.CHUNK, chunk["step"], problem)
    return _matrix(actions, len(channels.names))


def _check_kinds(name: str, values: list[Any], kinds: Collection[type]) -> None:
    """Raises ValueError where a value is a text or a flag, which an array would take for a number."""
    if wrong := [value for value in values if type(value) not in kinds]:
        raise ValueError(f"a {name} of {str(wrong[0])[:80]!r}, wanted a number")


def _pictures(path: Path, camera: Camera, encoded: list[bytes]) -> np.ndarray:
    """uint8 (K, H, W, 3)."""
    if len(encoded) * camera.height * camera.width * 3 > MAX_EPISODE_BYTES:
        raise ValueError(f"pictures of more than {MAX_EPISODE_BYTES} bytes")
    pictures = np.empty((len(encoded), camera.height, camera.width, 3), np.uint8)
    for picture, message in zip(pictures, encoded, strict=True):
        data = messages.camera_bytes(message)
        if (found := size_of(data)) != (camera.height, camera.width):
            wanted = f"{camera.height} x {camera.width} pixels, as its robot's camera"
            raise _misfit(
                path,
                messages.CAMERA + camera.name,
                None,
                Misfit("each picture", wanted, f"{found[0]} x {found[1]}"),
            )
        picture[...] = decode(data)
    return pictures


def _misfit(path: Path, topic: str, step: int | None, problem: Misfit) -> UserError:
    where = topic if step is None else f"{topic} of step {step}"
    return UserError(
        f"{path} does not fit the robot that it states: {where}: {problem}. Record or convert it again with that "
        "robot, or move it away."
    )


def _matrix(rows: list, width: int) -> np.ndarray:
    """float32 (len(rows), width); None becomes NaN."""
    with np.errstate(over="ignore"):  # what is too large for a float32 is infinite
        numbers = np.array(rows, np.float64).astype(np.float32)
    return numbers.reshape(len(rows), width)
