"""The numbered files of a LeRobot data set that is being written: tables and videos, many episodes a file."""

import os
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from imfvla.robot import Camera
from imfvla.sources.checks import missing_extra
from imfvla.sources.lerobot import layout

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise missing_extra("lerobot", error) from error

MB = 2**20
DATA_MB, VIDEO_MB = 100, 200  # a file that has grown so far is followed by the next
# Every second frame is a key frame, so that any is reached at once; no frame is shown out of order.
CODECS = {
    "av1": ("libsvtav1", {"g": "2", "crf": "30", "preset": "12"}),
    "h264": ("libx264", {"g": "2", "bf": "0", "crf": "20", "preset": "veryfast"}),
}


class Tables:
    """A series of parquet files of one schema, one row group a call of `write`."""

    def __init__(self, root: Path, template: str, schema: pa.Schema) -> None:
        self.schema, self.place = schema, (0, 0)
        self._root, self._template, self._writer = root, template, None

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Appends rows and returns chunk and file that hold them."""
        if self._writer is not None and self._stream.tell() >= DATA_MB * MB:
            self.close()
            self.place = _next(self.place)
        if self._writer is None:
            path = self._root / self._template.format(chunk_index=self.place[0], file_index=self.place[1])
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = path.open("wb")
            self._writer = pq.ParquetWriter(self._stream, self.schema)
        self._writer.write_table(table, row_group_size=max(1, len(table)))
        return self.place

    def close(self) -> None:
        if self._writer is not None:
            writer, self._writer = self._writer, None
            try:
                writer.close()
            finally:
                self._stream.close()


class Videos:
    """A series of videos of one camera; frame i of a file is shown at i / fps."""

    def __init__(self, root: Path, key: str, camera: Camera, fps: int, codec: str) -> None:
        self._root, self._key, self._camera, self._fps, self._codec = root, key, camera, fps, codec
        self._place, self._container = (0, 0), None
        self.info: Mapping[str, Any] = {
            "video.height": camera.height, "video.width": camera.width, "video.codec": codec,
            "video.pix_fmt": "yuv420p", "video.fps": fps, "video.channels": 3, "has_audio": False,
            "is_depth_map": False, "video.g": 2, "video.crf": int(CODECS[codec][1]["crf"]),
        }  # fmt: skip

    def add(self, frames: np.ndarray, shown: np.ndarray) -> dict[str, Any]:
        """Appends frame `shown[step]` for each step; returns what the table of episodes says of it."""
        if self._container is not None and self._num_bytes >= VIDEO_MB * MB:
            self.close()
            self._place = _next(self._place)
        if self._container is None:
            self._open()
        start = self._num_frames
        for number in shown:
            picture = av.VideoFrame.from_ndarray(frames[number], format="rgb24")
            picture.pts, picture.time_base = self._num_frames, Fraction(1, self._fps)
            self._mux(picture)
            self._num_frames += 1
        return {
            f"videos/{self._key}/chunk_index": self._place[0],
            f"videos/{self._key}/file_index": self._place[1],
            f"videos/{self._key}/from_timestamp": start / self._fps,
            f"videos/{self._key}/to_timestamp": self._num_frames / self._fps,
        }

    def close(self) -> None:
        if self._container is not None:
            container, self._container = self._container, None
            try:
                for packet in self._stream.encode():
                    container.mux(packet)
            finally:
                container.close()

    def _open(self) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # its encoder prints a page for every file otherwise
        path = self._root / layout.VIDEO.format(
            video_key=self._key, chunk_index=self._place[0], file_index=self._place[1]
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        self._num_frames = self._num_bytes = 0
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        name, options = CODECS[self._codec]
        self._stream = self._container.add_stream(name, rate=self._fps, options=dict(options))
        self._stream.width, self._stream.height = self._camera.width, self._camera.height
        self._stream.pix_fmt, self._stream.time_base = "yuv420p", Fraction(1, self._fps)

    def _mux(self, picture: av.VideoFrame) -> None:
        for packet in self._stream.encode(picture):
            self._num_bytes += packet.size
            self._container.mux(packet)


def _next(place: tuple[int, int]) -> tuple[int, int]:
    chunk, file = place
    return (chunk, file + 1) if file + 1 < layout.FILES_A_CHUNK else (chunk + 1, 0)
