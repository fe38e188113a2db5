"""McapSink: writes one episode, demonstration or rollout, as one MCAP file."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from imfvla.environment import Environment, bodies_of
from imfvla.episode import EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.recording import messages, schemas
from imfvla.recording.channels import Channels, numbers
from imfvla.recording.pictures import encode
from imfvla.recording.scene import at_time, body_names, frame_transforms, scene_update
from imfvla.storage.files import make_folder, put_file, write_remedy

TRANSFORMS_HZ = 10  # of /tf messages, at most
INFO, WARNING = 2, 3  # levels of foxglove.Log


class McapSink:
    """An `episode.Sink` that writes `path` with the topics of `imfvla.recording.messages`.

    Frames are those that the actor saw (`Decision.images`); with `render_every`, steps divisible by
    it that have no frames get those of `env.look()`. They are PNG if `lossless`, as training needs
    them, else JPEG. `begin` expects `env` after its reset and `step` after the action, so the
    frames and body poses that the simulator shows then belong to the next step and are kept until it
    comes. An environment without `scene` has no /tf and no /scene.

    The file is written beside `path` under a hidden name and renamed by `end`; `abort`, any error while writing and,
    with `only_success`, an episode without success remove it and leave an earlier file at `path` unchanged. Raises
    UserError naming `path` where it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        lossless: bool = True,
        render_every: int | None = None,
        only_success: bool = False,
    ) -> None:
        if render_every is not None and render_every < 1:
            raise ValueError(f"render_every must be at least 1 or None, found {render_every}.")
        self.path = Path(path)
        self._part = self.path.with_name(f".{self.path.name}.part")
        self._lossless = lossless
        self._render_every, self._only_success = render_every, only_success
        self._stream = None

    def begin(self, env: Environment, info: EpisodeInfo) -> None:
        with self._cleaning_up():
            make_folder(self.path.parent)
            self._part.unlink(missing_ok=True)  # of a killed process, or a link to somewhere else
            self._stream = open(self._part, "xb")  # noqa: SIM115  closed by end or abort
            self._writer = Writer(
                self._stream, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
            )
            self._writer.start(profile="", library="imfvla")
            self._channels: dict[str, int] = {}
            self._schemas: dict[str, int] = {}
            self._num_steps = self._stage = 0
            self._writer.add_metadata(messages.EPISODE_RECORD, messages.info_record(info))
            self._writer.add_attachment(
                messages.EPOCH_NS,
                messages.EPOCH_NS,
                messages.CONFIG_ATTACHMENT,
                "application/json",
                messages.dump(info.config),
            )
            self._state, self._action = Channels(info.robot.state), Channels(info.robot.action)
            self._state_schema = self._state.schema("imfvla.RobotState")
            self._action_schema = schemas.object_of(
                "imfvla.RobotAction",
                clean=self._action.schema("imfvla.CleanAction"),
                executed=self._action.schema("imfvla.ExecutedAction"),
            )
            self._sizes = {camera.name: (camera.height, camera.width) for camera in info.robot.cameras}
            self._transforms_every = max(1, round(info.robot.control_hz / TRANSFORMS_HZ))
            bodies = bodies_of(env)
            self._bodies = [] if bodies is None else body_names(bodies.model)
            self._scene = None if bodies is None else scene_update(bodies.model)
            self._see(env, 0)

    def step(self, env: Environment, step: Step) -> None:
        with self._cleaning_up():
            self._time = messages.time_ns(step.time_s)
            if self._num_steps == 0 and self._scene is not None:
                self._write(messages.SCENE, schemas.SCENE_UPDATE, at_time(self._scene, self._time))
            if self._transforms is not None:
                self._write(
                    messages.TRANSFORMS, schemas.FRAME_TRANSFORMS, at_time(self._transforms, self._time)
                )
            images = step.decision.images
            self._write_images(self._frames if images is None else images)
            self._write(messages.STATE, self._state_schema, self._state.tree(step.state))
            self._write_decision(step)
            reward = {"reward": float(step.reward), "stage": int(step.stage)}
            self._write(messages.REWARD, schemas.REWARD, reward)
            if step.stage != self._stage:
                self._log(INFO, f"step {step.index}: stage {self._stage} -> {step.stage}")
                self._stage = step.stage
            self._num_steps += 1
            self._see(env, step.index + 1)

    def end(self, result: EpisodeResult) -> None:
        with self._cleaning_up():
            if self._num_steps:
                outcome = result.failure or ("success" if result.success else "no success")
                level = WARNING if result.failure else INFO
                self._log(level, f"end after {result.num_steps} steps: {outcome}")
            self._writer.add_metadata(messages.RESULT_RECORD, messages.result_record(result, self._num_steps))
            self._writer.finish()
            self._stream.close()
            if result.success or not self._only_success:
                put_file(self._part, self.path)
            else:
                self._part.unlink()
            self._stream = None

    def abort(self) -> None:
        """Removes what was written so far. Does nothing before `begin` and after `end`."""
        if self._stream is not None:
            with suppress(OSError):  # closing flushes, and a full disk must not keep the file
                self._stream.close()
            self._stream = None
            self._part.unlink(missing_ok=True)

    def _see(self, env: Environment, next_step: int) -> None:
        """Keeps the current frames and poses for the next step, if that step is recorded."""
        bodies = bodies_of(env) if next_step % self._transforms_every == 0 else None
        self._transforms = None if bodies is None else frame_transforms(self._bodies, bodies.data)
        self._frames = env.look() if self._render_every and next_step % self._render_every == 0 else {}

    def _write_images(self, images: Mapping[str, np.ndarray]) -> None:
        for view, frame in images.items():
            encoded, image_format = encode(np.ascontiguousarray(frame), lossless=self._lossless)
            if frame.shape[:2] != self._sizes[view]:
                raise UserError(
                    f"Camera {view} must show {_size(self._sizes[view])} pixels, as the robot says, found "
                    f"{_size(frame.shape[:2])}: correct the environment."
                )
            message = messages.camera_message(self._time, view, encoded, image_format)
            self._write(messages.CAMERA + view, schemas.COMPRESSED_IMAGE, message)

    def _write_decision(self, step: Step) -> None:
        decision = step.decision
        action = {
            messages.CLEAN: self._action.tree(decision.action),
            messages.EXECUTED: self._action.tree(decision.executed),
        }
        self._write(messages.ACTION, self._action_schema, action)
        if decision.imitate is not None:
            self._write(messages.IMITATE, schemas.IMITATE, {"imitate": bool(decision.imitate)})
        if decision.chunk is not None:
            chunk = {
                "step": step.index,
                "names": self._action.names,
                "actions": numbers(decision.chunk),
            }
            self._write(messages.CHUNK, schemas.ACTION_CHUNK, chunk)
        if decision.inference_ms is not None:
            self._write(messages.INFERENCE, schemas.INFERENCE, {"ms": float(decision.inference_ms)})

    def _log(self, level: int, text: str) -> None:
        log = {"timestamp": messages.stamp(self._time), "level": level, "message": text, "name": "episode"}
        self._write(messages.LOG, schemas.LOG, log | {"file": "", "line": 0})

    def _write(self, topic: str, schema: schemas.Schema, message: Any) -> None:
        if topic not in self._channels:
            name = schema["title"]
            if name not in self._schemas:
                data = messages.dump(schema)
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", data)
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])
        data = message if isinstance(message, bytes) else messages.dump(message)
        self._writer.add_message(self._channels[topic], self._time, data, self._time)

    @contextmanager
    def _cleaning_up(self) -> Iterator[None]:
        """Aborts when its block fails; errors of the file system become a UserError that names the file."""
        try:
            yield
        except OSError as error:
            self.abort()
            raise UserError(
                f"Cannot record {self.path}: {error.strerror or error}; {write_remedy(error)}."
            ) from error
        except BaseException:
            self.abort()
            raise


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]} x {shape[1]}"
