"""LeRobotDataset v3: data sets of Hugging Face's LeRobot, read and written without its package."""

from imfvla.sources.lerobot.source import LeRobotSource, open_source
from imfvla.sources.lerobot.writer import LeRobotWriter

__all__ = ["LeRobotSource", "LeRobotWriter", "open_source"]
