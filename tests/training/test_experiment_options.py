"""The config of an experiment as one object."""

import pytest

from imfvla.command.composition import compose
from imfvla.config.horizon import Horizon
from imfvla.errors import UserError
from imfvla.training.experiment import read_experiment


@pytest.fixture(scope="module")
def config() -> dict:
    return compose("train", ["+exp=socket_ph32_exec16", "seed=3"])


def test_every_part_is_typed(config):
    options = read_experiment(config)
    assert (options.name, options.seed) == ("socket_ph32_exec16", 3)
    assert options.horizon == Horizon(obs=1, pred=32, exec=16)
    assert options.observation.views == tuple(config["observation"]["views"])
    assert options.training.steps == config["training"]["steps"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, r"^seed must be between 0 and"),
        ({"training": {"step": 5}}, r"Unknown key training\.step \(did you mean steps\?\)"),
        ({"observation": {"views": ["top"]}}, r"Missing key observation\.image_size"),
        ({"horizon": {"obs": 1, "pred": 8, "exec": 16}}, r"horizon\.exec must not exceed horizon\.pred"),
    ],
)
def test_what_is_wrong_is_named_by_its_key(config, changes, message):
    with pytest.raises(UserError, match=message):
        read_experiment(config | changes)
