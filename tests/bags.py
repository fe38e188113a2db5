"""Writes ROS 2 bags of a robot whose joints and pictures tell the time."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from mcap_ros2.writer import Writer

HEADER = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
TYPES = {
    "sensor_msgs/msg/JointState": HEADER.format(
        fields="string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "sensor_msgs/msg/CompressedImage": HEADER.format(fields="string format\nuint8[] data"),
    "sensor_msgs/msg/Image": HEADER.format(
        fields="uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "foxglove_msgs/msg/CompressedVideo": """builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
    "std_msgs/msg/Float64MultiArray": "float64[] data\n",
    "std_msgs/msg/String": "string data\n",
    "test_msgs/msg/Gripper": HEADER.format(fields="float64[2] fingers\nstring note"),
}
BEGIN = 1_700_000_000 * 10**9  # [ns]


class BagWriter:
    """`write(topic, type, time_s, message)`; the header's stamp is filled with the time, less `delay_s`."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("wb")
        self._writer = Writer(self._stream)
        self._schemas = {}

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, *error) -> None:
        self._writer.finish()
        self._stream.close()

    def write(self, topic, kind, time_s, message, delay_s=0.0, stamped=True):
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_msgdef(kind, TYPES[kind])
        time = BEGIN + round(time_s * 1e9)
        taken = time - round(delay_s * 1e9) if stamped else 0
        if "Header" in TYPES[kind]:
            stamp = {"sec": taken // 10**9, "nanosec": taken % 10**9}
            message = {"header": {"stamp": stamp, "frame_id": "base"}} | message
        if "CompressedVideo" in kind:
            message = {
                "timestamp": {"sec": taken // 10**9, "nanosec": taken % 10**9},
                "frame_id": "eye",
            } | message
        self._writer.write_message(topic, self._schemas[kind], message, log_time=time)


def grey(time_s: float, height: int = 16, width: int = 24) -> np.ndarray:
    """uint8 (H, W, 3) whose red tells the time, 10 levels a tenth of a second."""
    return np.full((height, width, 3), (round(100 * time_s) % 256, 30, 60), np.uint8)


def png(frame: np.ndarray) -> bytes:
    return cv2.imencode(".png", frame[..., ::-1])[1].tobytes()


def h264(frames: list[np.ndarray]) -> list[bytes]:
    """One packet a frame, the first a key frame, as camera drivers send them."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.height, encoder.width = frames[0].shape[:2]
    encoder.pix_fmt, encoder.time_base, encoder.framerate = "yuv420p", Fraction(1, 20), 20
    encoder.options = {"tune": "zerolatency", "crf": "10"}
    packets = [
        packet for frame in frames for packet in encoder.encode(av.VideoFrame.from_ndarray(frame, "rgb24"))
    ]
    return [bytes(packet) for packet in packets]


def joints(time_s: float) -> dict:
    """Names in an order that changes, as some drivers' does; elbow is the time, shoulder its negative."""
    position = {"elbow": time_s, "other": 7.0, "shoulder": -time_s}
    names = sorted(position, reverse=round(time_s * 1000) % 2 == 0)
    return {"name": names, "position": [position[name] for name in names], "velocity": [], "effort": []}


def write_bag(
    path: Path, end_s: float = 1.0, joints_hz=100, camera_hz=30, skip=(9.0, 9.0), size=(16, 24)
) -> Path:
    """Joints, a camera and commands from 0 to `end_s`; no joints between the two times of `skip`."""
    with BagWriter(path) as bag:
        events = [(number / joints_hz, "joints") for number in range(round(end_s * joints_hz) + 1)]
        events += [(number / camera_hz + 0.004, "camera") for number in range(round(end_s * camera_hz) + 1)]
        events += [(number / 50, "command") for number in range(round(end_s * 50) + 1)]
        for time, event in sorted(events):
            if event == "joints" and not skip[0] < time < skip[1]:
                bag.write("/joint_states", "sensor_msgs/msg/JointState", time, joints(time))
            elif event == "camera":
                image = {"format": "png", "data": png(grey(time, *size))}
                bag.write("/camera", "sensor_msgs/msg/CompressedImage", time + 0.02, image, delay_s=0.02)
            elif event == "command":
                bag.write("/command", "std_msgs/msg/Float64MultiArray", time, {"data": [-time - 1, time + 1]})
    return path
