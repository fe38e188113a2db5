"""What pyproject.toml cannot say: folders beside the package travel inside it in a wheel (imfvla/config/assets.py)."""

from setuptools import find_packages, setup

FOLDERS = {"imfvla.conf": "conf", "imfvla.experiments": "experiments"}

setup(packages=[*find_packages(include=["imfvla", "imfvla.*"]), *FOLDERS], package_dir=FOLDERS)
