"""The pictures of one view while a bag is read: the size of the first one, then those that are asked for."""

import numpy as np

from imfvla.errors import UserError
from imfvla.sources.ros2.bag import Received
from imfvla.sources.ros2.fields import picture
from imfvla.sources.ros2.video import KIND, Video


class Eye:
    """Sees every message of a topic and decodes no more of them than needed.

    Without `numbers` it takes the size of the first picture. With them it fills `frames`, uint8 (K, H, W, 3): place k
    by message `numbers[k]`, as recorded. One picture can be the nearest of several steps.
    """

    def __init__(self, numbers: np.ndarray | None = None, frames: np.ndarray | None = None) -> None:
        self.size: tuple[int, int] | None = None
        self._frames = frames
        self._places: dict[int, list[int]] = {}
        for place, number in enumerate([] if numbers is None else numbers.tolist()):
            self._places.setdefault(number, []).append(place)
        self._left = set(self._places)
        self._video: Video | None = None

    @property
    def is_done(self) -> bool:
        return self.size is not None if self._frames is None else not self._left

    def see(self, message: Received, number: int) -> None:
        """Takes message `number`. Raises UserError where it is no picture, or one of another size."""
        self._last = message
        if self.is_done:
            return
        if message.kind == KIND:
            self._video = self._video or Video()
            for shown, frame in self._video.frames(message, number):
                self._keep(shown, frame)
        elif self._frames is None or number in self._left:
            self._keep(number, picture(message))

    def end(self) -> None:
        """After the last message. Raises UserError where a picture is missing that a video should have had."""
        if self._video is not None and not self.is_done:
            for shown, frame in self._video.rest():
                self._keep(shown, frame)
        if not self.is_done:
            self._refuse_start()

    def _keep(self, number: int, frame: np.ndarray) -> None:
        if self._frames is None:
            if self.size is None and number > 0:
                self._refuse_start()
            self.size = self.size or frame.shape[:2]
            return
        for place in self._places.get(number, ()):
            if frame.shape != self._frames.shape[1:]:
                raise self._misfit(frame)
            self._frames[place] = frame
        self._left.discard(number)

    def _misfit(self, frame: np.ndarray) -> UserError:
        _, height, width, _ = self._frames.shape
        return UserError(
            f"{self._last.file}: pictures of {self._last.topic} must be {height} x {width}, as the first of all, found "
            f"{frame.shape[0]} x {frame.shape[1]}; leave this bag out."
        )

    def _refuse_start(self) -> None:
        raise UserError(
            f"{self._last.file}: video of {self._last.topic} must begin with a key frame and have a frame a message, "
            "found frames that cannot be decoded; record the bag again, or choose another topic."
        )
