"""Which robot a config is about: stated by the task, our own two arms, or what environment or data says."""

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from imfvla.config.views import ViewOptions, view_options
from imfvla.environments import BIMANUAL, environment_of, kind_of
from imfvla.options import part_of
from imfvla.robot import RobotSpec

KEY = "robot"  # of a run's config, its checkpoints' description and a task's YAML
NO_ENVIRONMENT = "none"  # as task.name: the run trains on data and is judged on data


def robot_of(config: Mapping[str, Any]) -> RobotSpec:
    """The robot of a config that `conf/train.yaml` composed, or of a run directory.

    A run's config has it under `robot`; runs from before that key are of the two arms. Raises UserError where it is
    stated wrongly, or where a view has no camera.
    """
    views = view_options(config)
    robot = _robot(config, views)
    for view in views.views:
        robot.camera(view)
    return robot


def place_of_robot(config: Mapping[str, Any]) -> str:
    """Where a user finds the robot of a config: "task.robot" where that is stated, else the task that brings it."""
    task = part_of(config, "task")
    return f"task.{KEY}" if task.get(KEY) is not None else f"task={task['name']}"


def with_robot(config: Mapping[str, Any]) -> dict[str, Any]:
    """The config with its robot resolved, as it goes into a run directory."""
    return {**config, KEY: robot_of(config).to_json()}


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
