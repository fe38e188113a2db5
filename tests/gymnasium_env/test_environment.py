"""A Gymnasium environment that a YAML describes: what it plays, and one sentence for each contradiction."""

import sys

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the extra gym is not installed")

from worlds import ID, OBSERVATION, Slider, config

from imfvla.errors import UserError
from imfvla.gymnasium_env import load
from imfvla.gymnasium_env.options import read_task


@pytest.fixture
def env():
    loaded = load(config(), OBSERVATION)
    yield loaded
    loaded.close()


def test_it_offers_what_the_yaml_says(env):
    assert (env.name, env.instruction, env.paraphrases, env.goal) == ("slider", "slide", ("go there",), None)
    assert env.views == ("front", "side")
    assert env.robot.control_hz == 20
    assert env.stages == ("near", "far")
    assert env.time_limit_steps == 5


def test_a_seed_determines_the_start(env):
    starts = {}
    for seed in (3, 4, 3):
        env.reset(seed)
        starts.setdefault(seed, []).append((env.start_digest(), env.state().tobytes()))
    assert starts[3][0] == starts[3][1]
    assert starts[3][0][0] != starts[4][0][0]
    assert env.state().dtype == np.float32


def test_success_stays_and_stages_are_of_the_moment(env):
    env.reset(0)
    outcomes = [env.step(np.array([x, 0.5])) for x in (0.6, 1.0, 0.2, 0.0, 0.0)]
    assert [outcome.stage for outcome in outcomes] == [1, 2, 0, 0, 0]
    assert [outcome.success for outcome in outcomes] == [False, True, True, True, True]
    assert [outcome.ended for outcome in outcomes] == [False] * 4 + [True]
    np.testing.assert_allclose(env.state(), [0, 0.5])


def test_the_worlds_own_end_ends_the_episode(env):
    env.reset(0)
    assert env.step(np.array([2.0, 0.0])).ended


def test_pictures_are_drawn_when_someone_looks(env):
    env.reset(0)
    before = env.gymnasium.unwrapped.drawn
    env.step(np.zeros(2))
    assert env.gymnasium.unwrapped.drawn == before
    pictures = env.look()
    assert env.gymnasium.unwrapped.drawn == before + 1
    for picture in pictures.values():
        assert (picture.shape, picture.dtype) == ((12, 16, 3), np.uint8)
    assert (pictures["front"] == 50).all()
    assert (pictures["side"] == 1).all()
    assert env.render("side", 24, 32).shape == (24, 32, 3)


def test_a_wrong_action_is_refused(env):
    env.reset(0)
    for action in (np.zeros(3), np.array([np.nan, 0])):
        with pytest.raises(UserError, match="2 finite numbers"):
            env.step(action)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"speed": 1}, "Unknown key task.speed"),
        ({"id": "os:Slider-v0"}, "task.id must name an environment without a module"),
        ({"id": "imfvla-tests/Glider-v0"}, "task.id=imfvla-tests/Glider-v0 cannot be made"),
        ({"package": "os"}, "task.package must be null or one of gym_aloha, gym_pusht"),
        ({"kwargs": {"colour": 3}}, "task.kwargs={'colour': 3} do not fit"),
        ({"kwargs": {"wrappers": []}}, "task.kwargs must be without wrappers"),
        ({"kwargs": {"repeatable": False}}, "starts differently from the same seed"),
        ({"state": ["place"]}, "task.state[0] must be a place below observation or info"),
        ({"state": ["observation/pose"]}, "in observation, its keys are place, pixels"),
        ({"state": ["observation/place", "info/hidden"]}, "task.robot.state names 2 channels, but"),
        ({"pictures": {"front": "render"}}, "task.pictures.side must be where its picture comes from"),
        ({"pictures": {"front": "camera/top", "side": "render"}}, "no camera of"),
        ({"pictures": {"front": "observation/place", "side": "render"}}, "must be a picture, uint8"),
        (
            {"success": {"of": "info/won", "at_least": 1}},
            "task.success.of must be a place of the environment",
        ),
        ({"success": {"of": "score", "at_least": 1}}, "task.success.of must be reward, or a place below"),
        ({"stages": {"a": 1, "b": 1}}, "task.stages must be rewards that all differ"),
        ({"time_limit_steps": 0}, "task.time_limit_steps must be at least 1"),
        ({"robot": {"control_hz": 50}}, "task.robot.control_hz must be 20"),
        (
            {"robot": {"action_max": [3, 1]}},
            "task.robot.action_min and action_max of place/x [m] must lie in",
        ),
        ({"robot": {"cameras": []}}, "There is no view 'front'"),
        ({"robot": {"state": ["x [m]", "x [m]"]}}, "names that all differ"),
        (
            {"robot": {"action": ["x"], "relative_to": [None], "action_min": [0], "action_max": [1]}},
            "task.robot.action names 1 numbers, but",
        ),
    ],
)
def test_a_contradiction_is_named(changes, named):
    with pytest.raises(UserError) as error:
        load(config(**changes), OBSERVATION)
    assert named in str(error.value)


@pytest.mark.parametrize("changes", [{"kwargs": {"repeatable": False}}, {"robot": {"control_hz": 7}}])
def test_a_refused_environment_is_closed(changes, monkeypatch):
    closed = []
    monkeypatch.setattr(Slider, "close", lambda self: closed.append(self))
    with pytest.raises(UserError):
        load(config(**changes), OBSERVATION)
    assert len(closed) == 1


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UserError, match=r"needs the package gymnasium: run `pip install .*\[gym\]"):
        load(config(), OBSERVATION)


def test_the_order_of_stages_is_that_of_their_rewards():
    assert list(read_task(config(), OBSERVATION).stages) == ["near", "far"]


def test_the_world_has_a_digest(env):
    other = load(config(kwargs={"repeatable": True}), OBSERVATION)
    assert env.model_digest() != other.model_digest()
    assert ID in env.gymnasium.spec.id
