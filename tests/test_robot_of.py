"""Which robot a config is about, old and new ones alike, and what is refused before anything is done with it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from any_robot import MemorySource, robot_of_size

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.policy import build_policy
from imfvla.robot_of import robot_of, with_robot
from imfvla.rollouts.actor import ChunkActor
from imfvla.storage.run_directory import DERIVED_KEYS, EXECUTION_KEYS, RunDirectory, differences
from imfvla.tasks.bimanual_robot import bimanual_robot
from imfvla.training.checkpoint import load_policy, load_weights
from imfvla.training.data import refuse_other_source
from imfvla.types import MAX_WORDS, Observation

SHIPPED = Path(__file__).resolve().parent.parent / "experiments" / "pretrained"
RESULTS = SHIPPED.parent / "results"
VIEWS = ("front", "top", "r_wrist")
ARMS = bimanual_robot(VIEWS, (96, 96))
# The mean over a chunk of two observations, as it was before a policy took its sizes from a robot.
MEAN_BEFORE = {"socket_ph32_exec16": 0.5364055661, "transfer_ph32_exec16": 0.5756734565}


def test_our_own_tasks_have_two_arms_and_a_task_may_state_its_robot():
    config = compose("train")
    assert robot_of(config) == ARMS
    assert robot_of(with_robot(config)) == ARMS
    other = robot_of_size(7, 7)
    stated = config | {
        "task": config["task"] | {"robot": other.to_json()},
        "observation": {"views": ["camera_0"], "image_size": [16, 16]},
    }
    assert robot_of(stated) == other


@pytest.mark.parametrize(
    ("task", "views"),
    [
        (["task=socket"], ["front", "top", "r_wrist"]),
        (["task=gate", "observation.views=[top]"], ["top"]),
        (["task=gate", "observation.views=null"], ["front", "top", "r_wrist"]),
        (["task=pusht"], ["top"]),
        (["task=pusht", "observation.views=null"], ["top"]),
    ],
)
def test_what_a_policy_sees_follows_from_its_robot(task, views):
    config = with_robot(compose("train", task))
    assert config["observation"]["views"] == views
    assert [camera["name"] for camera in config["robot"]["cameras"]] == views


def test_a_policy_is_built_for_all_cameras_of_a_robot_that_is_stated():
    config = compose("train", ["task=none", "demos=mcap", "demos.path=nowhere"])
    config["task"]["robot"] = robot_of_size(7, 7, num_cameras=2).to_json()
    assert config["observation"]["views"] is None
    assert build_policy(config).views == ("camera_0", "camera_1")


def test_a_robot_without_cameras_is_named():
    config = compose("train")
    config["task"]["robot"] = robot_of_size(7, 7).to_json() | {"cameras": []}
    config["observation"]["views"] = None
    with pytest.raises(UserError, match=r"observation\.views must be one or more views, found \[\]"):
        with_robot(config)


def test_a_view_without_a_camera_is_named():
    config = compose("train")
    config["task"]["robot"] = robot_of_size(7, 7).to_json()
    with pytest.raises(
        UserError, match=r"no view 'front': the robot's cameras are camera_0.*observation\.views"
    ):
        robot_of(config)


def test_a_wrongly_stated_robot_is_named_with_its_key():
    config = compose("train")
    config["task"]["robot"] = robot_of_size(7, 7).to_json() | {"control_hz": 0}
    with pytest.raises(UserError, match=r"control_hz must be from 0.01 to 10000"):
        robot_of(config)
    config["task"]["robot"] = {"state": ["a"]}
    with pytest.raises(UserError, match=r"Missing key task\.robot\.cameras"):
        robot_of(config)


@pytest.mark.parametrize("name", MEAN_BEFORE)
def test_a_shipped_policy_gives_the_chunks_that_it_gave(name):
    """Its config states the sizes that are now handed in; with and without them it is the same policy, bit for bit."""
    run = RunDirectory(SHIPPED / name / "generator=imf_plain")
    old = run.config()
    assert old["state_dim"] == old["core"]["channels"] == 16
    new = {key: value for key, value in old.items() if key not in ("state_dim", "action_dim")} | with_robot(
        old
    )
    new["encoder"] = {
        key: value for key, value in old["encoder"].items() if key not in ("views", "state_dim")
    }
    new["core"] = {key: value for key, value in old["core"].items() if key != "channels"}
    rebuilt = build_policy(new)
    load_weights(rebuilt, run.policy_weights())
    draw = torch.Generator().manual_seed(0)
    seen = Observation(
        torch.randint(0, 256, (2, 1, 3, 3, 96, 96), generator=draw, dtype=torch.uint8),
        torch.rand(2, 1, 16, generator=draw),
        torch.ones(2, MAX_WORDS, dtype=torch.int64),
    )
    noise = torch.randn(2, 32, 16, generator=draw)
    with torch.inference_mode():
        chunks = [policy.predict(seen, noise, 2) for policy in (load_policy(run), rebuilt.eval())]
    assert torch.equal(*chunks)
    assert chunks[0].mean().item() == pytest.approx(MEAN_BEFORE[name], abs=1e-5)


def test_committed_runs_do_not_differ_from_their_configs_of_today():
    """Keys that follow from the robot are no differences, so that finished runs are not done again."""
    for name in MEAN_BEFORE:
        old, new = (
            RunDirectory(SHIPPED / name / "generator=imf_plain").config(),
            compose("train", [f"+exp={name}", "generator=imf_plain"]),
        )
        differing = {text.split()[0] for text in differences(old, new, EXECUTION_KEYS)}
        assert not differing & {"demos.source", *DERIVED_KEYS}
    assert all(
        robot_of(yaml.safe_load(path.read_text())).control_hz == 50
        for path in RESULTS.glob("*/*/config.yaml")
    )


def test_a_size_that_contradicts_the_robot_is_named():
    config = compose("train")
    config["core"]["channels"] = 8
    with pytest.raises(
        UserError, match=r"core\.channels must be 16, as robot and observation have it, or left out"
    ):
        build_policy(config)


def test_an_environment_of_another_robot_is_refused_before_a_step():
    policy = build_policy(compose("train"))

    class Faster:
        name, instruction, robot = "faster", "go", replace(ARMS, control_hz=100.0)

    with pytest.raises(
        UserError, match=r"environment faster has another robot .* control_hz must be 50, found 100"
    ):
        ChunkActor(policy, policy.horizon, nfe=1, noise_seed=0).reset(Faster, 0)


def test_data_of_another_robot_is_refused():
    source = MemorySource(replace(robot_of_size(16, 16), cameras=ARMS.cameras))
    with pytest.raises(
        UserError,
        match=r"state channel 0 is left\S* .* in task=socket, but part_0\S* .* in .* demos\.source=scripted",
    ):
        refuse_other_source(compose("train"), source)


def test_weights_of_another_robot_are_refused_with_the_first_difference(tmp_path):
    run, weights = RunDirectory(tmp_path), tmp_path / "checkpoints" / "step-1"
    run.claim(with_robot(compose("train")))
    weights.mkdir(parents=True)
    stated = replace(ARMS, action_max=(9.0, *ARMS.action_max[1:])).to_json()
    (weights / "policy.json").write_text(json.dumps({"robot": stated}))
    with pytest.raises(
        UserError, match=r"config\.yaml has another robot .* action_max of left/joint_1 .* must be 9"
    ):
        load_policy(run)
