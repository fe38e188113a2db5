"""Statistics as LeRobot keeps them: of each episode, and pooled over all. Shapes: N samples, D numbers of a sample."""

from collections.abc import Mapping

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
KEYS = ("min", "max", "mean", "std", "count", *QUANTILES)
MAX_PICTURES, MIN_PICTURES, POWER = 10_000, 100, 0.75  # how many pictures of an episode LeRobot samples
LARGE, TARGET = 300, 150  # [px] pictures from the first on are thinned to about the second

Statistics = Mapping[str, np.ndarray]


def of_samples(values: np.ndarray) -> Statistics:
    """Of numbers (N, D): arrays (D,), and the count (1,)."""
    values = np.asarray(values, np.float64)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
    } | dict(zip(QUANTILES, quantiles, strict=True))


def of_pictures(frames: np.ndarray) -> Statistics:
    """Of pictures uint8 (K, H, W, 3) in [0, 1], thinned as LeRobot thins them: arrays (3, 1, 1), count (1,)."""
    num_samples = max(min(len(frames), MIN_PICTURES), min(int(len(frames) ** POWER), MAX_PICTURES))
    chosen = np.round(np.linspace(0, len(frames) - 1, num_samples)).astype(int)
    size = max(frames.shape[1:3])
    every = 1 if size < LARGE else max(1, size // TARGET)
    pixels = frames[chosen, ::every, ::every].reshape(-1, 3)
    found = {key: value.reshape(3, 1, 1) / 255 for key, value in of_samples(pixels).items() if key != "count"}
    return found | {"count": np.array([num_samples])}


class Pool:
    """Statistics over episodes: extremes, mean and deviation exactly, quantiles as means weighted by count."""

    def __init__(self) -> None:
        self._sums: dict[str, np.ndarray] | None = None

    def add(self, part: Statistics) -> None:
        count = part["count"]
        new = {"min": part["min"], "max": part["max"], "count": count}
        new |= {key: part[key] * count for key in ("mean", *QUANTILES)}
        # The sum of squares about zero, in float64 of an episode's statistics.
        new["squares"] = (part["std"] ** 2 + part["mean"] ** 2) * count
        if self._sums is None:
            self._sums = new
            return
        joined = {key: self._sums[key] + new[key] for key in new if key not in ("min", "max")}
        joined["min"] = np.minimum(self._sums["min"], new["min"])
        joined["max"] = np.maximum(self._sums["max"], new["max"])
        self._sums = joined

    def result(self) -> Statistics:
        assert self._sums is not None
        count = self._sums["count"]
        found = {key: self._sums[key] / count for key in ("mean", *QUANTILES)}
        variance = np.maximum(self._sums["squares"] / count - found["mean"] ** 2, 0)
        found |= {
            "min": self._sums["min"],
            "max": self._sums["max"],
            "std": np.sqrt(variance),
            "count": count,
        }
        return {key: found[key] for key in KEYS}
