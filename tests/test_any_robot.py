"""The contract: robots of other shapes, rates and cameras go through every part of the learning side."""

import numpy as np
import pytest
import torch
from any_robot import SENTENCE, MemorySource, names_of, robot_of_size

from imfvla.command.composition import compose
from imfvla.command.experiment import run_experiment
from imfvla.robot import RobotSpec
from imfvla.robot_of import robot_of
from imfvla.rollouts.actor import ChunkActor
from imfvla.storage.run_directory import DONE, RunDirectory
from imfvla.training.checkpoint import load_policy

SHAPES = ((7, 7), (8, 9), (14, 14), (20, 23))  # actions, states
TINY = [
    "task=none", "demos=mcap", "demos.path=none", "task.held_out=1", "observation.image_size=[16,16]",
    "size.width=20", "size.heads=2", "size.depth=1", "horizon.pred=8", "horizon.exec=4", "training.batch_size=2",
    "training.steps=2", "training.checkpoints=1", "training.threads=1", "evaluation.nfe=[1,2]",
]  # fmt: skip


def configured(robot: RobotSpec, *overrides: str) -> dict:
    """train.yaml for data of this robot, seen by all of its cameras."""
    return compose("train", [*TINY, f"observation.views=[{','.join(names_of(robot.cameras))}]", *overrides])


class StillWorld:
    """An environment that stays where it is."""

    name, instruction = "still", SENTENCE

    def __init__(self, robot: RobotSpec) -> None:
        self.robot = robot

    def state(self) -> np.ndarray:
        return np.zeros(len(self.robot.state), np.float32)

    def look(self) -> dict[str, np.ndarray]:
        return {c.name: np.zeros((c.height, c.width, 3), np.uint8) for c in self.robot.cameras}


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Trains and judges on episodes in memory, and returns the run directory."""

    def train(robot: RobotSpec, *overrides: str) -> RunDirectory:
        source = MemorySource(robot)
        monkeypatch.setattr("imfvla.sources.mcap.open_source", lambda options, *, where: source)
        run = RunDirectory(tmp_path / "run")
        run_experiment(configured(robot, f"demos.frames_directory={tmp_path}/frames", *overrides), run)
        return run

    return train


@pytest.mark.parametrize("control_hz", [10.0, 50.0])
@pytest.mark.parametrize("num_cameras", [1, 4])
@pytest.mark.parametrize(("num_actions", "num_states"), SHAPES)
def test_a_robot_of_any_shape_is_trained_stored_loaded_and_moved(
    trained, num_actions, num_states, num_cameras, control_hz
):
    robot = robot_of_size(num_actions, num_states, num_cameras=num_cameras, control_hz=control_hz)
    run = trained(robot)
    assert run.status()["state"] == DONE
    assert robot_of(run.config()) == robot

    policy = load_policy(run)
    assert policy.robot == robot
    actor, env = ChunkActor(policy, policy.horizon, nfe=1, noise_seed=0), StillWorld(robot)
    actor.reset(env, 0)
    decision = actor.act(env, env.state(), 0)
    assert decision.chunk.shape == (8, num_actions)
    assert (decision.executed >= np.float32(robot.action_min)).all()
    assert (decision.executed <= np.float32(robot.action_max)).all()

    moved = policy.chunks.denormalise(torch.zeros(1, 8, num_actions), torch.full((1, num_states), 0.5))
    still = policy.chunks.denormalise(torch.zeros(1, 8, num_actions), torch.zeros(1, num_states))
    torch.testing.assert_close((moved - still)[0, 0], 0.5 * torch.from_numpy(robot.relative).float())


@pytest.mark.parametrize(
    "core",
    ["core=act generator=act evaluation.nfe=[1]", "core=smolvla encoder=smolvla/cpu generator=smolvla"],
)
def test_other_cores_take_their_sizes_from_the_robot_too(trained, core):
    robot = robot_of_size(8, 9, num_cameras=2)
    policy = load_policy(trained(robot, *core.split()))
    assert policy.noise_shape == (8, 8)
