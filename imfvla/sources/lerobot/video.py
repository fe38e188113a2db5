"""Frames of a video at exact times. Shapes: K frames, H W pixels."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from imfvla.errors import UserError
from imfvla.sources.checks import bounded_pictures, misfit, shortened
from imfvla.sources.lerobot.layout import DOWNLOAD
from imfvla.storage.opening import ANYWHERE, DATA, checked

TOLERANCE = 0.1  # of a period: how far a frame may lie from its time


def read_frames(path: Path, times_s: np.ndarray, fps: float, size: tuple[int, int]) -> np.ndarray:
    """The frames of an mp4 at these ascending times [s]: uint8 (K, H, W, 3).

    Decoding starts at the last key frame before the first time, so any of many episodes in a file is reached at once.
    Raises UserError where the video has another size or rate, is shorter, damaged or missing.
    """
    bounded_pictures(len(times_s), *size, path, "its frames")
    frames = np.empty((len(times_s), *size, 3), np.uint8)
    try:
        # The format is stated, since a playlist that is named .mp4 would open other files.
        with av.open(str(checked(path, DATA, home=ANYWHERE)), format="mp4") as container:
            if not container.streams.video:
                raise misfit(path, "its streams", "a video", "none", DOWNLOAD)
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise misfit(
                    path, "its codec", "one that av decodes (others are not supported)", "another", DOWNLOAD
                )
            found = (stream.codec_context.height, stream.codec_context.width)
            if found != size:
                raise misfit(
                    path, "its size", f"{size[0]} x {size[1]}, as meta/info.json states", found, DOWNLOAD
                )
            stream.codec_context.thread_count = 1  # the frame store decodes several episodes at a time
            for start_s in (float(times_s[0]), None):
                if _fill(
                    frames, _from(container, stream, start_s), times_s, fps, path, retry=start_s is not None
                ):
                    break
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing: wanted a video there; {DOWNLOAD}.") from error
    except (av.FFmpegError, OSError, ValueError, TypeError, ArithmeticError) as error:
        raise UserError(f"{path} is no whole mp4 ({shortened(str(error))}); {DOWNLOAD}.") from error
    return frames


def _from(
    container: av.container.InputContainer, stream: av.VideoStream, start_s: float | None
) -> Iterator[av.VideoFrame]:
    """Frames in the order of their times from the key frame before `start_s`, or from the beginning."""
    start = 0 if start_s is None else round(Fraction(start_s) / stream.time_base)
    container.seek(max(0, start), stream=stream, backward=True)
    return container.decode(stream)


def _fill(
    frames: np.ndarray,
    decoded: Iterator[av.VideoFrame],
    times_s: np.ndarray,
    fps: float,
    path: Path,
    *,
    retry: bool,
) -> bool:
    """Copies the frame of each time. False where the first decoded frame comes too late and `retry` allows that."""
    tolerance, number, last = TOLERANCE / fps, 0, None
    for frame in decoded:
        if frame.pts is None:
            continue
        time = float(frame.pts * frame.time_base)
        if time < times_s[number] - tolerance:
            last = time
            continue
        if time > times_s[number] + tolerance:
            if last is None and number == 0 and retry:
                return False
            raise misfit(
                path,
                "its frames",
                f"{fps:g} a second, one at {times_s[number]:.4f} s",
                f"none between {'the start' if last is None else f'{last:.4f} s'} and {time:.4f} s",
                DOWNLOAD,
            )
        if (frame.height, frame.width) != frames.shape[1:3]:
            raise misfit(
                path, "the size of its frames", frames.shape[1:3], (frame.height, frame.width), DOWNLOAD
            )
        frames[number] = frame.to_ndarray(format="rgb24")
        last, number = time, number + 1
        if number == len(times_s):
            return True
    end = "no frame" if last is None else f"an end at {last:.4f} s"
    raise misfit(
        path, "its length", f"a frame at {times_s[number]:.4f} s, as the metadata says", end, DOWNLOAD
    )
