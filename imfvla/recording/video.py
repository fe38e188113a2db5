"""Episodes as mp4 videos, views side by side above a status line."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from imfvla.episode import CONTROL_HZ, EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.files import write_remedy

QUALITY = 20  # x264's constant rate factor: visually lossless is about 18
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
            self.path.parent.mkdir(parents=True, exist_ok=True)
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
            self._part.replace(self.path)
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
        self._stream.options = {"crf": str(QUALITY), "preset": "veryfast", "threads": "1"}
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


def side_by_side(pictures: Sequence[np.ndarray], caption: str) -> np.ndarray:
    """Pictures uint8 (H, W, 3) in a row above a fitted line of text; small ones are enlarged by a whole factor."""
    row = np.concatenate(pictures, axis=1)
    factor = -(-MIN_WIDTH // row.shape[1])
    row = row.repeat(factor, axis=0).repeat(factor, axis=1)
    line = np.zeros((CAPTION_HEIGHT, row.shape[1], 3), np.uint8)
    (width, _), _ = cv2.getTextSize(caption, FONT, CAPTION_SCALE, 1)
    scale = CAPTION_SCALE * min(1.0, (row.shape[1] - 2 * CAPTION_MARGIN) / max(width, 1))
    (_, height), baseline = cv2.getTextSize(caption, FONT, scale, 1)
    origin = (CAPTION_MARGIN, (CAPTION_HEIGHT + height - baseline // 2) // 2)
    cv2.putText(line, caption, origin, FONT, scale, WHITE, 1, cv2.LINE_AA)
    return np.concatenate([row, line])


class VideoSink:
    """An `episode.Sink` that films every `every`-th control step of an episode in real time.

    Renders `views` at `size` (H, W) [px] through `env.render`, after the action, with the stage and the
    return so far. Errors and `abort` leave nothing behind.
    """

    def __init__(
        self, path: str | Path, *, views: Sequence[str], size: tuple[int, int], every: int = 2
    ) -> None:
        if not views or every < 1:
            raise ValueError(f"Wanted at least one view and every >= 1, found {views!r} and {every}.")
        self.path = Path(path)
        self._views, self._size, self._every = tuple(views), tuple(size), every
        self._writer: Mp4Writer | None = None

    def begin(self, env: Any, info: EpisodeInfo) -> None:
        self._writer = Mp4Writer(self.path, CONTROL_HZ / self._every)
        self._return = 0.0
        method = f"infer{info.metadata['nfe']}" if "nfe" in info.metadata else info.kind
        self._title = f"{info.task}  seed {info.seed}  {method}"

    def step(self, env: Any, step: Step) -> None:
        self._return += step.reward
        if step.index % self._every == 0:
            status = f"{step.time_s:5.2f} s  stage {step.stage}  return {self._return:.0f}"
            pictures = [env.render(view, *self._size) for view in self._views]
            self._writer.add(side_by_side(pictures, f"{self._title}  {status}"))

    def end(self, result: EpisodeResult) -> None:
        self._writer.close()
        self._writer = None

    def abort(self) -> None:
        if self._writer is not None:
            self._writer.abort()
            self._writer = None
