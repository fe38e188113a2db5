"""Builds a Gymnasium environment from its YAML, and checks the one against the other before anything is recorded."""

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from imfvla.errors import UserError
from imfvla.gymnasium_env.environment import GymnasiumEnvironment
from imfvla.gymnasium_env.options import RENDER, GymnasiumTask, read_task
from imfvla.gymnasium_env.packages import GYMNASIUM, cameras_of, import_gymnasium, register, registered_by
from imfvla.process.gl import select_before_simulators

SLACK = 1e-4  # of limits that are written with a few digits
TRIED_SEED = 0
MAX_NAMED = 20  # environments in a message


def load(task: Mapping[str, Any], observation: Mapping[str, Any]) -> GymnasiumEnvironment:
    """The environment that the config groups `task` and `observation` describe.

    Its spaces are compared with the robot of the YAML, two resets and one step are played. Raises UserError where a key
    is wrong, a package is missing, or the environment is another than the YAML says.
    """
    wanted = read_task(task, observation)
    gymnasium = import_gymnasium()
    select_before_simulators()
    register(wanted.package, wanted.id)
    draws = RENDER in (wanted.pictures[view] for view in wanted.views)
    mode = {"render_mode": "rgb_array"} if draws else {}
    try:
        env = gymnasium.make(
            wanted.id,
            max_episode_steps=-1,  # the limit is ours
            disable_env_checker=True,
            **mode,
            **wanted.kwargs,
        )
    except gymnasium.error.Error as error:
        raise UserError(f"task.id={wanted.id} cannot be made ({error}): {_remedy(wanted)}.") from error
    except (TypeError, ValueError, NotImplementedError) as error:
        raise UserError(
            f"task.kwargs={wanted.kwargs} do not fit {wanted.id} ({error}): correct them."
        ) from error
    loaded = GymnasiumEnvironment(env, wanted, cameras_of(wanted.package, env))
    with ExitStack() as refused:
        refused.callback(loaded.close)
        _check_actions(env.action_space, wanted)
        _check_rate(env.metadata, wanted)
        _try(loaded)
        refused.pop_all()  # it is not
    return loaded


def _remedy(task: GymnasiumTask) -> str:
    """What to do where the environment cannot be made, whatever registered it."""
    if task.package is None:
        return "correct it, or name in task.package what registers it"
    if task.id in import_gymnasium().registry:
        return "correct it"
    found = registered_by(task.package)
    return (
        f"task.package={task.package} is imported, but registers nothing under that id (it registers "
        f"{', '.join(found[:MAX_NAMED]) or 'nothing'}); correct task.id, or let the package register it when it is "
        f"imported or in a function that an entry point of {GYMNASIUM} names"
    )


def _check_actions(space: Any, task: GymnasiumTask) -> None:
    """Raises UserError unless the actions of `task.robot` lie in the environment's space."""
    count = len(task.robot.action)
    shape, kind = getattr(space, "shape", None), type(space).__name__
    if kind != "Box" or shape != (count,):
        raise UserError(
            f"task.robot.action names {count} numbers, but {task.id} takes {kind} {shape}: it must take one list "
            "of numbers, and each has its name."
        )
    for number, name in enumerate(task.robot.action):
        found = float(space.low[number]), float(space.high[number])
        wanted = task.robot.action_min[number], task.robot.action_max[number]
        if wanted[0] < found[0] - SLACK or wanted[1] > found[1] + SLACK:
            raise UserError(
                f"task.robot.action_min and action_max of {name} must lie in {found}, the limits of {task.id}, "
                f"found {wanted}."
            )


def _check_rate(metadata: Mapping[str, Any], task: GymnasiumTask) -> None:
    rate = metadata.get("render_fps")
    if rate is not None and abs(float(rate) - task.robot.control_hz) > SLACK * float(rate):
        raise UserError(
            f"task.robot.control_hz must be {rate:g}, the frames per second of {task.id}, found "
            f"{task.robot.control_hz:g}."
        )


def _try(env: GymnasiumEnvironment) -> None:
    """Two resets, one step and one look. Raises UserError where a place is missing or a start is not repeatable."""
    digests = []
    for _ in range(2):
        env.reset(TRIED_SEED)
        env.state()
        digests.append(env.start_digest())
    if digests[0] != digests[1]:
        raise UserError(
            f"task.id={env.task.id} starts differently from the same seed, so no two methods could be compared on it: "
            "its reset must draw from the seed alone."
        )
    low, high = np.float32(env.robot.action_min), np.float32(env.robot.action_max)
    env.look()
    env.step(np.clip(0, low, high))
    env.state()
