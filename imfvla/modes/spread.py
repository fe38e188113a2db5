"""How much samples depend on their noise, and how far consecutive chunks disagree.

Shapes: N observations, K samples of each, Tp predicted steps, A action.
"""

from collections.abc import Sequence

import numpy as np

from imfvla.robot import RobotSpec, unit_of


def joints_of(robot: RobotSpec) -> list[int]:
    """The channels of a robot's actions that are angles."""
    return [index for index, channel in enumerate(robot.action) if unit_of(channel) == "rad"]


def measure_spread(
    chunks: np.ndarray, demonstrated: np.ndarray, scale: np.ndarray
) -> dict[str, float | None]:
    """Of samples (N, K, Tp, A), K at least 2, beside what was demonstrated (N, Tp, A), in units of `scale` (Tp, A).

    `spread` is the standard deviation over the noise at one observation. `spread_ratio` is the same as a share of the
    demonstrations' deviation from the samples' mean there: 1 for samples distributed as the demonstrations are, 0 for
    a policy that ignores its noise (the spread-error ratio of ensemble forecasts).
    """
    mean = chunks.mean(axis=1)
    variance = np.mean(chunks.var(axis=1, ddof=1) / scale**2)
    # The mean of K samples is itself off by a K-th of their variance.
    error = np.mean(np.square((demonstrated - mean) / scale)) - variance / chunks.shape[1]
    ratio = float(np.sqrt(variance / error)) if error > 0 else None
    return {"spread": float(np.sqrt(variance)), "spread_ratio": ratio}


def measure_jumps(
    chunks: np.ndarray, later: np.ndarray, executed: int, scale: np.ndarray, joints: Sequence[int]
) -> dict[str, float | None]:
    """Root mean square difference over the steps that chunks (N, K, Tp, A) share with those of `executed` steps later.

    `jump_rad` is over the channels `joints`, `jump` over all in units of `scale` (Tp, A), that of the earlier chunk.
    None where no step is shared, and where there are no such channels.
    """
    if executed >= chunks.shape[2]:
        return {"jump_rad": None, "jump": None}
    difference = later[:, :, :-executed] - chunks[:, :, executed:]
    return {
        "jump_rad": _rms(difference[..., list(joints)]) if joints else None,
        "jump": _rms(difference / scale[executed:]),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
