"""Episodes as mp4 videos, views side by side above a status line."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from imfvla.environment import Environment
from imfvla.episode import EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.storage.files import make_folder, put_file, write_remedy

QUALITY = 20  # x264's constant rate factor: visually lossless is about 18
FRAMES_HZ = 12.5  # of videos of faster robots, nearly: drawing is most of what a frame costs
PRESET = "superfast"  # of x264: two thirds of the time of "veryfast", and a third more bytes
FONT = cv2.FONT_HERSHEY_SIMPLEX
CAPTION_HEIGHT, CAPTION_MARGIN = 28, 6  # [px]
MIN_WIDTH = 480  # [px] of a row: the least that holds a legible caption
CAPTION_SCALE = 0.5  # of the font, at most; long captions shrink until they fit
WHITE = (255, 255, 255)


class Mp4Writer:
    """H.264 in yuv420p, which every player and browser shows; equal frames make equal files.

    Written beside `path` under a hidden name that `close` renames and `abort` removes. Raises UserError
    naming `path` where it cannot be written.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path = Path(path)
        self._part = self.path.with_name(f".{self.path.name}.part")
        self._stream = None
        try:
            make_folder(self.path.parent)
            self._part.unlink(missing_ok=True)  # of a killed process, or a link to somewhere else
            self._container = av.open(str(self._part), "w", format="mp4", options={"fflags": "+bitexact"})
        except OSError as error:
            raise self._unwritable(error) from error
        self._rate = Fraction(fps).limit_denominator(1000)

    def add(self, frame: np.ndarray) -> None:
        """Appends an RGB frame uint8 (H, W, 3); an odd height or width loses its last row or column."""
        frame = np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
        try:
            if self._stream is None:
                self._start(frame.shape[0], frame.shape[1])
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            self._container.mux(self._stream.encode(picture))
        except OSError as error:
            self.abort()
            raise self._unwritable(error) from error

    def close(self) -> None:
        """Ends the video; without any frame there is no file."""
        if self._stream is None:
            self.abort()
            return
        try:
            self._container.mux(self._stream.encode())
            self._container.close()
            put_file(self._part, self.path)
        except OSError as error:
            self.abort()
            raise self._unwritable(error) from error

    def abort(self) -> None:
        """Removes what was written so far."""
        with suppress(OSError):  # closing flushes, and a full disk must not keep the file
            self._container.close()
        self._part.unlink(missing_ok=True)

    def _start(self, height: int, width: int) -> None:
        self._stream = self._container.add_stream("libx264", rate=self._rate)
        self._stream.height, self._stream.width, self._stream.pix_fmt = height, width, "yuv420p"
        self._stream.options = {"crf": str(QUALITY), "preset": PRESET, "threads": "1"}
        self._stream.codec_context.flags |= av.codec.context.Flags.bitexact

    def _unwritable(self, error: OSError) -> UserError:
        return UserError(f"Cannot write video {self.path}: {error.strerror or error}; {write_remedy(error)}.")


def write_mp4(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes RGB frames uint8 (H, W, 3) as a video; see `Mp4Writer`."""
    writer = Mp4Writer(path, fps)
    try:
        for frame in frames:
            writer.add(frame)
    except BaseException:
        writer.abort()
        raise
    writer.close()


def steps_between_frames(control_hz: float) -> int:
    """Control steps from one frame of a video to the next, so that it has some FRAMES_HZ and shows whole steps."""
    return max(1, round(control_hz / FRAMES_HZ))


def status_line(time_s: float, stage: int | None, total: float) -> str:
    """What a caption says of a step; `stage` is None where the task has none."""
    middle = "" if stage is None else f"  stage {stage}"
    return f"{time_s:5.2f} s{middle}  return {total:.4g}"


def side_by_side(pictures: Sequence[np.ndarray], caption: str) -> np.ndarray:
    """Pictures uint8 (H, W, 3) in a row above a fitted line of text; small ones are enlarged by a whole factor.

    Pictures lower than the highest stand on black.
    """
    total = sum(picture.shape[1] for picture in pictures)
    factor = -(-MIN_WIDTH // total)
    height = factor * max(picture.shape[0] for picture in pictures)
    frame = np.zeros((height + CAPTION_HEIGHT, factor * total, 3), np.uint8)
    left = 0
    for picture in pictures:
        if factor > 1:
            picture = picture.repeat(factor, axis=0).repeat(factor, axis=1)
        frame[: picture.shape[0], left : left + picture.shape[1]] = picture
        left += picture.shape[1]
    line = frame[height:]
    (width, _), _ = cv2.getTextSize(caption, FONT, CAPTION_SCALE, 1)
    scale = CAPTION_SCALE * min(1.0, (frame.shape[1] - 2 * CAPTION_MARGIN) / max(width, 1))
    (_, height), baseline = cv2.getTextSize(caption, FONT, scale, 1)
    origin = (CAPTION_MARGIN, (CAPTION_HEIGHT + height - baseline // 2) // 2)
    cv2.putText(line, caption, origin, FONT, scale, WHITE, 1, cv2.LINE_AA)
    return frame


class VideoSink:
    """An `episode.Sink` that films an episode in real time, at some `FRAMES_HZ` where control is faster.

    Renders `views` at `height` [px], in the proportions of their cameras, through `env.render`, after the action, with
    the stage, where the task has stages, and the return so far. Errors and `abort` leave nothing behind.
    """

    def __init__(self, path: str | Path, *, views: Sequence[str], height: int) -> None:
        if not views:
            raise ValueError("Wanted at least one view, found none.")
        self.path = Path(path)
        self._views, self._height = tuple(views), height
        self._writer: Mp4Writer | None = None

    def begin(self, env: Environment, info: EpisodeInfo) -> None:
        every = self._every = steps_between_frames(info.robot.control_hz)
        self._writer = Mp4Writer(self.path, info.robot.control_hz / every)
        cameras = map(info.robot.camera, self._views)
        self._sizes = {c.name: (self._height, round(self._height * c.width / c.height)) for c in cameras}
        self._return = 0.0
        method = f"infer{info.metadata['nfe']}" if "nfe" in info.metadata else info.kind
        self._title = f"{info.task}  seed {info.seed}  {method}"

    def step(self, env: Environment, step: Step) -> None:
        self._return += step.reward
        if step.index % self._every == 0:
            stage = step.stage if env.stages else None
            status = status_line(step.time_s, stage, self._return)
            pictures = [env.render(view, *size) for view, size in self._sizes.items()]
            self._writer.add(side_by_side(pictures, f"{self._title}  {status}"))

    def end(self, result: EpisodeResult) -> None:
        self._writer.close()
        self._writer = None

    def abort(self) -> None:
        if self._writer is not None:
            self._writer.abort()
            self._writer = None
