"""Physics, control steps, rendered views and demonstrations of a task."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from imfvla import tasks
from imfvla.benchmarks.clock import rate, times_ms
from imfvla.collection import collect
from imfvla.recording import Recordings

MEASURE_S = 1.0  # seconds of each rate
FRAMES = 50  # rendered per view


def measure_simulation(env: Any) -> dict[str, float]:
    """Rates of one process [1/s] and the median time of a frame [ms], averaged over the views."""
    env.reset(seed=0)
    hold = env.state()
    control = rate(lambda: _step(env, hold), MEASURE_S)
    physics = rate(env.physics.step, MEASURE_S)
    frames = times_ms([lambda view=view: env.look([view]) for view in env.views], FRAMES)
    return {
        "physics_steps_per_s": physics,
        "control_steps_per_s": control,
        "ms_per_view": float(np.median(frames, axis=1).mean()),
    }


def measure_demonstrations(config: Mapping[str, Any], directory: Path) -> tuple[dict[str, float], Recordings]:
    """Records three demonstrations below `directory`, as `imfvla.collect` would, and times the last two.

    Returns the rate of one process [1/min] and the recordings.
    """
    demos = {**config["demos"], "directory": str(directory), "workers": 0, "episodes": 1}
    collect(config["task"], config["observation"], demos)
    report = collect(config["task"], config["observation"], {**demos, "episodes": 3})
    return {"demonstrations_per_min": 60 * report.num_new / report.wall_s}, report.recordings


def make_environment(config: Mapping[str, Any]) -> Any:
    """The environment of a composed config."""
    observation = config["observation"]
    return tasks.load(
        config["task"]["name"],
        variant=config["task"]["variant"],
        views=tuple(observation["views"]),
        image_size=tuple(observation["image_size"]),
    )


def _step(env: Any, action: Any) -> None:
    if env.step(action).last():
        env.reset(seed=0)
