"""Whether an episode is what its source's robot says, before anything is made of it."""

from collections.abc import Collection
from typing import Any

import numpy as np

from imfvla.errors import UserError
from imfvla.robot import RobotSpec
from imfvla.sources.base import EpisodeArrays


def check_episode(episode: EpisodeArrays, robot: RobotSpec, views: Collection[str]) -> None:
    """Raises UserError naming episode, key, what was wanted and found, and the remedy."""
    steps = len(episode.state)
    _require(episode, steps > 0, "state", "at least one control step", "none")
    for key, channels in (("state", robot.state), ("action", robot.action)):
        values = getattr(episode, key)
        shape = (steps, len(channels))
        wanted = f"float32 of shape {shape}, {steps} steps of {len(channels)} channels"
        is_right = values.dtype == np.float32 and values.shape == shape
        _require(episode, is_right, key, wanted, f"{values.dtype} of shape {values.shape}")
        if not np.isfinite(values).all():
            step, channel = np.argwhere(~np.isfinite(values))[0]
            _require(
                episode,
                False,
                f"{key} of {channels[channel]}",
                "finite",
                f"{values[step, channel]} at step {step}",
            )
    if (flags := episode.imitate) is not None:
        is_right = flags.dtype == bool and flags.shape == (steps,) and flags.any()
        wanted = f"bool of shape {(steps,)}, true at one step at least"
        _require(episode, bool(is_right), "imitate", wanted, f"{flags.dtype} of shape {flags.shape}")
    _require(episode, bool(episode.instructions), "instructions", "at least one sentence", "none")
    taken = np.asarray(episode.image_steps)
    inside = taken.ndim == 1 and (taken >= 0).all() and (taken < steps).all() and (np.diff(taken) > 0).all()
    _require(episode, bool(inside), "image_steps", f"ascending steps below {steps}", taken.tolist()[:8])
    for view in views:
        camera = robot.camera(view)
        _require(
            episode, view in episode.images, f"camera {view}", "recorded", ", ".join(episode.images) or "none"
        )
        pictures = np.asarray(episode.images[view])
        shape = (len(taken), camera.height, camera.width, 3)
        is_right = pictures.dtype == np.uint8 and pictures.shape == shape
        wanted = f"uint8 of shape {shape}, {len(taken)} frames of the camera's size"
        _require(episode, is_right, f"camera {view}", wanted, f"{pictures.dtype} of shape {pictures.shape}")


def _require(episode: EpisodeArrays, condition: bool, key: str, wanted: str, found: Any) -> None:
    if not condition:
        raise UserError(
            f"Episode {episode.name}: {key} must be {wanted}, found {found}. Correct the episode, or leave it out."
        )
