"""gym-pusht's environment, drawn on demand and without the mark of the last action."""

import numpy as np
import pytest

pytest.importorskip("gym_pusht", reason="gym-pusht is not installed")

from imfvla.command.composition import compose
from imfvla.gymnasium_env import load


@pytest.fixture(scope="module")
def env():
    config = compose("train", ["task=pusht", "observation.image_size=[48,48]"])
    return load(config["task"], config["observation"])


def test_a_picture_shows_no_action(env):
    env.reset(1)
    env.step(np.array([200.0, 300.0]))
    picture = env.look()["top"].astype(int)
    assert picture.shape == (48, 48, 3)
    assert (picture[..., 0] - picture[..., 2]).max() < 60  # nothing red


def test_pushing_nothing_is_no_success(env):
    env.reset(1)
    outcome = env.step(env.state())
    assert not outcome.success
    assert outcome.stage == 0
    assert env.stages == ()
