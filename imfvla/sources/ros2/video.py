"""H.264 of foxglove_msgs/CompressedVideo: one message is one frame, which needs the frames before it."""

from collections.abc import Iterator

import av
import numpy as np

from imfvla.errors import UserError
from imfvla.recording.pictures import MAX_PIXELS
from imfvla.sources.checks import shortened
from imfvla.sources.ros2.bag import Received

KIND = "foxglove_msgs/msg/CompressedVideo"


class Video:
    """Decodes the messages of one topic in the order of recording."""

    def __init__(self) -> None:
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.thread_count = 1

    def frames(self, message: Received, number: int) -> Iterator[tuple[int, np.ndarray]]:
        """The frames that message `number` completes: their numbers and uint8 (H, W, 3).

        Raises UserError where the message is of another format or damaged.
        """
        self._last = message
        decoded = message.decode()
        if decoded.format != "h264":
            raise self._bad("h264 (others are not supported)", decoded.format)
        packet = av.Packet(bytes(decoded.data))
        packet.pts = packet.dts = number
        yield from self._decoded(packet)

    def rest(self) -> Iterator[tuple[int, np.ndarray]]:
        """The frames that the decoder kept back, after the last message."""
        yield from self._decoded(None)

    def _decoded(self, packet: av.Packet | None) -> Iterator[tuple[int, np.ndarray]]:
        try:
            for frame in self._decoder.decode(packet):
                if frame.height * frame.width > MAX_PIXELS:
                    raise self._bad(f"of at most {MAX_PIXELS} pixels", f"{frame.height} x {frame.width}")
                if frame.pts is not None:
                    yield frame.pts, frame.to_ndarray(format="rgb24")
        except av.FFmpegError as error:
            raise self._bad("H.264 from a key frame on", str(error)) from error

    def _bad(self, wanted: str, found: str) -> UserError:
        return UserError(
            f"{self._last.file}: video of {self._last.topic} must be {wanted}, found {shortened(found)}; "
            "choose another topic, or record the bag again."
        )
