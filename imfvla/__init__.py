"""imfvla: fast robot action generation, from scripted demonstrations to the paper's tables."""

__version__ = "0.1.0"
