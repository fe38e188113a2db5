"""How an episode's parts are written as JSON messages, and read back.

Every message of control step s carries the simulated time of step s, counted from a fixed epoch, so that
equal episodes make equal files. Numbers are preserved exactly: a float32 is written as the float64 that equals
it, a non-finite one as null.
"""

import base64
import json
from collections.abc import Collection
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.episode import EpisodeInfo, EpisodeResult
from imfvla.errors import UserError
from imfvla.recording.mcap_file import ForeignRecording
from imfvla.recording.records import Config, InfoRecord, ResultRecord
from imfvla.robot import RobotSpec
from imfvla.storage.documents import parse_json
from imfvla.storage.records import as_record
from imfvla.tasks.bimanual_robot import bimanual_robot

FORMAT = "2"  # "1" had no robot, which was that of this package's own tasks
READABLE = ("1", FORMAT)
EPOCH_NS = 1_767_225_600 * 10**9  # 2026-01-01T00:00:00Z
EPISODE_RECORD = "imfvla.episode"  # metadata: EpisodeInfo, written first
RESULT_RECORD = "imfvla.result"  # metadata: EpisodeResult, written last: a file without it is incomplete
RECORDS = (EPISODE_RECORD, RESULT_RECORD)
CONFIG_ATTACHMENT = "config.json"
REMEDY = "restore it from a copy, or move it away and collect or evaluate again"

CAMERA = "/camera/"
STATE = "/robot/state"
ACTION = "/robot/action"
CLEAN, EXECUTED = "clean", "executed"  # parts of an action's message
CHUNK = "/policy/chunk"
INFERENCE = "/policy/inference_ms"
IMITATE = "/expert/imitate"
REWARD = "/episode/reward"
LOG = "/episode/log"
TRANSFORMS = "/tf"
SCENE = "/scene"


def time_ns(time_s: float) -> int:
    """Log time of a simulated time [s]."""
    return EPOCH_NS + round(time_s * 1e9)


def stamp(log_time_ns: int) -> dict[str, int]:
    """Foxglove's `time` of a log time."""
    return {"sec": log_time_ns // 10**9, "nsec": log_time_ns % 10**9}


def dump(value: Any) -> bytes:
    """Compact JSON; numpy scalars and arrays are allowed."""
    return json.dumps(value, separators=(",", ":"), default=_plain).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be recorded as JSON: {value!r}")


def camera_message(log_time_ns: int, view: str, encoded: bytes, image_format: str) -> bytes:
    """foxglove.CompressedImage."""
    data = base64.b64encode(encoded).decode("ascii")
    return dump({"timestamp": stamp(log_time_ns), "frame_id": view, "format": image_format, "data": data})


def camera_bytes(message: bytes) -> bytes:
    """The encoded picture inside a foxglove.CompressedImage."""
    return base64.b64decode(parse_json(message)["data"], validate=True)


def info_record(info: EpisodeInfo) -> dict[str, str]:
    """Metadata record of an episode's beginning: JSON texts by field; the config travels as attachment."""
    values = {field.name: getattr(info, field.name) for field in fields(info) if field.name != "config"}
    values["robot"] = info.robot.to_json()
    return {"format": FORMAT} | {name: dump(value).decode() for name, value in values.items()}


def require_records(found: Collection[str]) -> None:
    """Raises ForeignRecording where a file has no record of ours among those `found`, ValueError where it lacks one."""
    missing = [name for name in RECORDS if name not in found]
    if len(missing) == len(RECORDS):
        raise ForeignRecording(f"the metadata record {EPISODE_RECORD}")
    if missing:
        raise ValueError(f"no metadata record {missing[0]}")


def read_info(record: dict[str, str], config: dict[str, Any], path: Path) -> EpisodeInfo:
    """Inverse of `info_record`.

    Raises UserError naming `path` where it is of another format, and the key where its robot contradicts itself.
    """
    if (found := record["format"]) not in READABLE:
        raise UserError(
            f"{path} has recording format {found}, wanted {' or '.join(READABLE)}: read it with the version of imfvla "
            "that wrote it, or move it away and collect again."
        )
    values = {name: parse_json(text) for name, text in record.items() if name != "format"}
    robot = _robot(values, path)
    parts = as_record(
        {name: value for name, value in values.items() if name != "robot"}, InfoRecord, str(path), REMEDY
    )
    config = as_record(config, Config, f"{path}, {CONFIG_ATTACHMENT}", REMEDY)
    return EpisodeInfo(**parts | {"views": tuple(parts["views"]), "robot": robot, "config": config})


def _robot(values: dict[str, Any], path: Path) -> RobotSpec:
    """The robot of a recording. The one place that knows what those from before it was recorded are of."""
    image_size = values.pop("image_size", None)
    if "robot" in values:
        return RobotSpec.from_json(values["robot"], f"{path}: robot")
    height, width = image_size
    return bimanual_robot(values["views"], (height, width))  # refuses sizes that no picture has


def result_record(result: EpisodeResult, num_recorded: int) -> dict[str, str]:
    """Metadata record of an episode's end, with the number of steps that were recorded."""
    names = (field.name for field in fields(result))
    return {"recorded_steps": str(num_recorded)} | {
        name: dump(getattr(result, name)).decode() for name in names
    }


def read_result(record: dict[str, str], path: Path) -> EpisodeResult:
    """Inverse of `result_record`. Raises UserError naming `path` and the key that is not of its type."""
    values = {name: parse_json(text) for name, text in record.items() if name != "recorded_steps"}
    parts = as_record(values, ResultRecord, str(path), REMEDY)
    return EpisodeResult(
        **parts | {name: tuple(parts[name]) for name in ("first_step_of_stage", "inference_ms")}
    )
