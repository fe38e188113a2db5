"""Gymnasium environments that nobody here wrote, described by YAML alone (`conf/task/gymnasium.yaml`)."""

from imfvla.gymnasium_env.loading import load

__all__ = ["load"]
