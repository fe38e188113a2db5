"""The contract: robots of other shapes, rates and cameras go from recordings to a row of a table."""

from functools import partial
from pathlib import Path

import av
import pytest
import torch
from any_robot import MemorySource, names_of, robot_of_size
from fakes import PlainEnvironment

from imfvla.command import experiment
from imfvla.command.completion import is_complete
from imfvla.command.composition import compose
from imfvla.command.experiment import run_experiment
from imfvla.config.protocol import EvaluationOptions
from imfvla.errors import UserError
from imfvla.policy import Policy
from imfvla.recording import read_episode
from imfvla.reporting.runs import rows
from imfvla.reporting.table_row import table_of
from imfvla.robot import RobotSpec
from imfvla.robot_of import robot_of
from imfvla.rollouts import workbench
from imfvla.rollouts.evaluation import evaluate
from imfvla.sources.mcap_writer import McapWriter
from imfvla.storage.run_directory import DONE, RunDirectory
from imfvla.training.checkpoint import load_policy

SHAPES = ((7, 7), (8, 9), (14, 14), (20, 23))  # actions, states
TINY = [
    "task=none", "demos=mcap", "task.held_out=1", "observation.image_size=[16,16]",
    "size.width=20", "size.heads=2", "size.depth=1", "horizon.pred=8", "horizon.exec=4", "training.batch_size=2",
    "training.steps=2", "training.checkpoints=1", "training.threads=1", "evaluation.nfe=[1,2]",
]  # fmt: skip


def configured(*overrides: str) -> dict:
    """train.yaml for data of a robot; that it is seen by all of its cameras need not be said."""
    return compose("train", [*TINY, *overrides])


def build(robot: RobotSpec, run: Path, step: int) -> tuple[PlainEnvironment, Policy]:
    """A `workbench.Build` of a short world of the robot."""
    world = PlainEnvironment(time_limit_steps=10, name="plain", robot=robot, stages=())
    return world, load_policy(RunDirectory(run), step)


@pytest.fixture
def trained(tmp_path):
    """Records episodes, trains and judges on them, and returns the run directory."""

    def train(robot: RobotSpec, *overrides: str) -> RunDirectory:
        with McapWriter(tmp_path / "demos", robot) as writer:
            for episode in MemorySource(robot).episodes:
                writer.add(episode)
        run = RunDirectory(tmp_path / "run")
        run_experiment(configured(f"demos.path={tmp_path}/demos", *overrides), run)
        return run

    return train


@pytest.mark.parametrize("control_hz", [10.0, 50.0])
@pytest.mark.parametrize("num_cameras", [1, 4])
@pytest.mark.parametrize(("num_actions", "num_states"), SHAPES)
def test_a_robot_of_any_shape_goes_from_recordings_to_a_row_of_a_table(
    trained, num_actions, num_states, num_cameras, control_hz
):
    robot = robot_of_size(num_actions, num_states, num_cameras=num_cameras, control_hz=control_hz)
    run = trained(robot)
    assert run.status()["state"] == DONE
    assert robot_of(run.config()) == robot
    assert run.config()["observation"]["views"] == list(names_of(robot.cameras))

    policy = load_policy(run)
    assert policy.robot == robot
    moved = policy.chunks.denormalise(torch.zeros(1, 8, num_actions), torch.full((1, num_states), 0.5))
    still = policy.chunks.denormalise(torch.zeros(1, 8, num_actions), torch.zeros(1, num_states))
    torch.testing.assert_close((moved - still)[0, 0], 0.5 * torch.from_numpy(robot.relative).float())

    workbench._bench.cache_clear()
    options = EvaluationOptions(episodes=2, first_seed=100_000, nfe=(1,), workers=0)
    (summary,) = evaluate(run, options, build=partial(build, robot))
    best = run.rollouts(summary["name"]) / summary["recordings"]["best"]["file"]
    episode = read_episode(best)
    assert episode.info.robot == robot
    assert episode.executed.shape == (10, num_actions)
    assert (episode.executed >= robot.action_min).all()
    assert (episode.executed <= robot.action_max).all()
    assert episode.chunks[4].shape == (8, num_actions)
    for camera in robot.cameras:
        assert episode.images[camera.name].shape == (3, camera.height, camera.width, 3)
    with av.open(str(best.with_suffix(".mp4"))) as film:
        (stream,) = film.streams.video
        assert stream.average_rate == {10: 10, 50: 12.5}[control_hz]
    (row,) = table_of(rows(run)).rows
    assert row[6] == "1/2"  # of seeds 100000 and 100001 the odd one


@pytest.mark.parametrize(
    "core",
    ["core=act generator=act evaluation.nfe=[1]", "core=smolvla encoder=smolvla/cpu generator=smolvla"],
)
def test_other_cores_take_their_sizes_from_the_robot_too(trained, core, tmp_path):
    robot = robot_of_size(8, 9, num_cameras=2)
    run = trained(robot, *core.split())
    assert load_policy(run).noise_shape == (8, 8)
    assert is_complete(configured(f"demos.path={tmp_path}/demos", *core.split()), run.path)


def test_a_number_that_is_not_finite_is_named_and_leaves_nothing_behind(tmp_path, monkeypatch):
    robot = robot_of_size(7, 7)
    source = MemorySource(robot)
    source.episodes[1].state[2, 3] = float("nan")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(experiment, "open_source", lambda config: source)
    config = configured("demos.path=demos")
    config["task"]["robot"] = robot.to_json()
    with pytest.raises(
        UserError, match=rf"{source.episodes[1].name}: state of .* must be finite, found nan at step 2"
    ):
        run_experiment(config, RunDirectory("run"))
    assert list(tmp_path.iterdir()) == []
