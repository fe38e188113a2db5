"""Which robot a config is about: stated by the task, our own two arms, or what environment or data says."""

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from imfvla.config.views import ViewOptions, view_options
from imfvla.environments import BIMANUAL, NO_ENVIRONMENT, environment_of, kind_of, seen_in
from imfvla.options import part_of
from imfvla.robot import RobotSpec

KEY = "robot"  # of a run's config, its checkpoints' description and a task's YAML


def robot_of(config: Mapping[str, Any]) -> RobotSpec:
    """The robot of a config that `conf/train.yaml` composed, or of a run directory.

    A run's config has it under `robot`; runs from before that key are of the two arms. Raises UserError where it is
    stated wrongly, or where a view has no camera.
    """
    seen = seen_in(config)
    robot = _robot(config, seen)
    for view in seen.views or ():
        robot.camera(view)
    return robot


def place_of_robot(config: Mapping[str, Any]) -> str:
    """Where a user finds the robot of a config: "task.robot" where that is stated, else the task that brings it."""
    task = part_of(config, "task")
    return f"task.{KEY}" if task.get(KEY) is not None else f"task={task['name']}"


def with_robot(config: Mapping[str, Any]) -> dict[str, Any]:
    """The config with its robot, and the cameras that are seen of it, as it goes into a run directory.

    Raises UserError as `robot_of` does, and where nothing is seen.
    """
    robot = robot_of(config)
    views = seen_in(config).views
    named = [camera.name for camera in robot.cameras] if views is None else list(views)
    seen = {**config, "observation": {**config["observation"], "views": named}, KEY: robot.to_json()}
    view_options(seen)
    return seen


def has_environment(config: Mapping[str, Any]) -> bool:
    """Whether policies are rolled out at the end, rather than judged on held-out episodes."""
    task = config.get("task")
    return not isinstance(task, Mapping) or task.get("name") != NO_ENVIRONMENT


def _robot(config: Mapping[str, Any], views: ViewOptions) -> RobotSpec:
    for where, group in ((KEY, config), (f"task.{KEY}", config.get("task", {}))):
        if group.get(KEY) is not None:
            return RobotSpec.from_json(group[KEY], where)
    # Imported here: a robot that is stated needs neither tasks nor data.
    if has_environment(config):
        if kind_of(part_of(config, "task")) != BIMANUAL:
            with closing(environment_of(config)) as env:
                return env.robot
        from imfvla.tasks.bimanual_robot import bimanual_robot

        return bimanual_robot(views.views, views.image_size)
    from imfvla.sources.opening import open_source

    return open_source(config).robot
