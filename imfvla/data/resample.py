"""Pictures at the size that a policy sees: the same pixels in training and in rollouts."""

from collections.abc import Sequence

import cv2
import numpy as np


def resample(picture: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """uint8 (H, W, 3) at `size` (height, width) [px]: means over areas, or itself where the sizes agree."""
    height, width = size
    if picture.shape[:2] == (height, width):
        return picture
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
