"""Every experiment file composes and builds at both scales, and takes a step on tiny data at the CPU's."""

from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import write_demonstrations

from imfvla.composition import CONFIG_DIRECTORY, compose
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.policy import build_policy
from imfvla.run_directory import RunDirectory
from imfvla.training.data import make_loader, prepare_windows
from imfvla.training.loop import Trainer
from imfvla.training.options import OptimOptions, TrainingOptions

EXPERIMENTS = sorted(path.stem for path in (CONFIG_DIRECTORY / "exp").glob("*.yaml"))
TINY = [
    "observation.image_size=[32,32]",
    "training.batch_size=2",
    "training.steps=1",
    "training.checkpoints=1",
    "training.threads=1",
]


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("recorded") / "demonstrations", num_episodes=2)


def test_both_tables_have_their_experiment():
    assert {"socket_ph32_exec16", "transfer_ph32_exec16"} <= set(EXPERIMENTS)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_steps_once(experiment, demonstrations, tmp_path):
    config = compose("train", [f"+exp={experiment}", *TINY])
    windows = prepare_windows(config, demonstrations)
    policy = build_policy(config, windows.statistics())
    options = build(TrainingOptions, config["training"], "training")
    optim = build(OptimOptions, config["optim"], "optim")
    run = RunDirectory(tmp_path)
    before = [parameter.detach().clone() for parameter in policy.parameters()]
    Trainer(
        policy, make_loader(config, windows), run, options, optim, seed=config["seed"], description={}
    ).train()
    assert run.weight_steps() == [1]
    after = list(policy.parameters())
    assert all(parameter.isfinite().all() for parameter in after)
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_builds_at_the_paper_s_scale(experiment):
    config = compose("train", [f"+exp={experiment}", "scale=paper"])
    build(TrainingOptions, config["training"], "training")
    build(OptimOptions, config["optim"], "optim")
    with torch.device("meta"):
        policy = build_policy(config)
    num_parameters = sum(parameter.numel() for parameter in policy.parameters())
    assert num_parameters > 5e6
    assert policy.noise_shape == (config["horizon"]["pred"], config["action_dim"])


def test_exec_beyond_pred_is_refused():
    config = compose("train", ["horizon.pred=8", "horizon.exec=16"])
    with pytest.raises(UserError, match=r"horizon\.exec must not exceed horizon\.pred.*exec=16 and pred=8"):
        build_policy(config)


def test_batches_depend_on_seed_and_number_alone(demonstrations):
    config = compose("train", TINY)
    windows = prepare_windows(config, demonstrations)
    one, other = make_loader(config, windows), make_loader(config, windows)
    next(one)
    other.load_state_dict(one.state_dict())
    first, second = next(one), next(other)
    for loader in (one, other):
        loader.close()
    assert np.array_equal(first.obs.images, second.obs.images)
    assert torch.equal(first.actions, second.actions)
