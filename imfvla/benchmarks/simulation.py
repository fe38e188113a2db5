"""Physics, control steps, rendered views and demonstrations of an environment."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imfvla.benchmarks.forcing import forcing
from imfvla.environment import Environment, bodies_of
from imfvla.process.stopwatch import rate, times_ms
from imfvla.recording import Recordings
from imfvla.sources.collection import collect

MEASURE_S = 1.0  # seconds of each rate
FRAMES = 50  # rendered per view


def measure_simulation(env: Environment) -> dict[str, float]:
    """Rates of one process [1/s] and the median time of a frame [ms], averaged over the views.

    Physics are timed where the environment shows its simulator and that has steps of its own.
    """
    env.reset(0)
    hold = _rest(env)
    control = rate(lambda: _step(env, hold), MEASURE_S)
    simulator = bodies_of(env)
    physics = {"physics_steps_per_s": rate(simulator.step, MEASURE_S)} if hasattr(simulator, "step") else {}
    cameras = [env.robot.camera(view) for view in env.views]
    frames = times_ms([partial(env.render, c.name, c.height, c.width) for c in cameras], FRAMES)
    return {
        **physics,
        "control_steps_per_s": control,
        "ms_per_view": float(np.median(frames, axis=1).mean()),
    }


def measure_demonstrations(config: Mapping[str, Any], directory: Path) -> tuple[dict[str, float], Recordings]:
    """Records three demonstrations below `directory`, as `imfvla.collect` would, and times the last two.

    Returns the rate of one process [1/min] and the share of forcing files to disk, and the recordings.
    """
    demos = {**config["demos"], "directory": str(directory), "workers": 0, "episodes": 1}
    collect(config["task"], config["observation"], demos)
    with forcing() as forced:
        report = collect(config["task"], config["observation"], {**demos, "episodes": 3})
    return {
        "demonstrations_per_min": 60 * report.num_new / report.wall_s,
        "forcing_percent": 100 * forced.seconds / report.wall_s,
    }, report.recordings


def _rest(env: Environment) -> np.ndarray:
    """Actions (A,) that move little: where the state is, and otherwise the middle of the limits."""
    robot = env.robot
    middle = np.mean([robot.action_min, robot.action_max], axis=0)
    return np.where(robot.relative, env.state()[robot.origin], middle)


def _step(env: Environment, action: np.ndarray) -> None:
    if env.step(action).ended:
        env.reset(0)
