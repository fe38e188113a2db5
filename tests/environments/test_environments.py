"""Which environment a config describes, and that the robot is known without a simulator where it can be."""

import subprocess
import sys
from types import ModuleType

import pytest
from fakes import PlainEnvironment

from imfvla.environments import environment_of
from imfvla.errors import UserError
from imfvla.robot_of import robot_of
from imfvla.tasks.catalogue import NAMES

SEEN = {"views": ["front"], "image_size": [16, 16]}


def test_a_kind_names_who_builds_the_environment(monkeypatch):
    asked, env = [], PlainEnvironment()
    module = ModuleType("imfvla.gymnasium_env")
    module.load = lambda task, observation: asked.append((task, observation)) or env
    monkeypatch.setitem(sys.modules, "imfvla.gymnasium_env", module)
    config = {"task": {"kind": "gymnasium", "name": "push"}, "observation": SEEN}
    assert environment_of(config) is env
    assert asked == [(config["task"], SEEN)]
    assert robot_of(config) == env.robot


@pytest.mark.parametrize(
    ("task", "observation", "named"),
    [
        ({"kind": "isaac", "name": "x"}, SEEN, "task.kind must be one of bimanual, gymnasium, found 'isaac'"),
        (
            {"name": "knitting", "variant": "easy"},
            SEEN,
            f"task.name must be one of {', '.join(sorted(NAMES))}",
        ),
        ({"name": "socket"}, SEEN, "Missing key task.variant"),
        ({"name": "socket", "variant": "easy"}, {"views": ["front"]}, "Missing key observation.image_size"),
        (
            {"name": "socket", "variant": "easy"},
            {**SEEN, "views": ["side"]},
            "There is no view 'side'; choose from front, top, r_wrist, l_wrist in observation.views",
        ),
    ],
)
def test_what_cannot_be_built_is_named(task, observation, named):
    with pytest.raises(UserError, match=named):
        environment_of({"task": task, "observation": observation})


def test_names_limits_and_robot_of_our_tasks_need_no_simulator():
    """In a process of its own: this one may have imported it already."""
    code = (
        "import sys\nfrom imfvla import tasks\nfrom imfvla.robot_of import robot_of\n"
        "seen = {'views': ['top'], 'image_size': [8, 8]}\n"
        "robot = robot_of({'task': {'name': tasks.NAMES[0]}, 'observation': seen})\n"
        "assert robot == tasks.bimanual_robot(('top',), (8, 8)) and tasks.TIME_LIMIT_STEPS == 700\n"
        "assert not {'mujoco', 'dm_control', 'torch'} & sys.modules.keys()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
