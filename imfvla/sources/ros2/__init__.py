"""ROS 2 bags in MCAP, read without ROS."""

from imfvla.sources.ros2.source import Ros2Source, open_source

__all__ = ["Ros2Source", "open_source"]
