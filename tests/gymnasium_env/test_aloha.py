"""gym-aloha's environments: drawn on demand, limited as their actuators are, and an expert for both tasks."""

import numpy as np
import pytest

pytest.importorskip("gym_aloha", reason="gym-aloha is not installed")

from imfvla.command.composition import compose
from imfvla.gymnasium_env import load
from imfvla.gymnasium_env.aloha_motion import Style, Track, transfer_tracks
from imfvla.gymnasium_env.experts import make_expert

SIZE = ["observation.image_size=[24,32]"]


@pytest.fixture(scope="module", params=["aloha_transfer"])
def config(request):
    return compose("train", [f"task={request.param}", *SIZE])


@pytest.fixture(scope="module")
def env(config):
    return load(config["task"], config["observation"])


def test_the_robot_has_the_limits_of_the_actuators(env):
    space = env.gymnasium.unwrapped.action_space
    np.testing.assert_allclose(space.low, env.robot.action_min, atol=1e-4)
    np.testing.assert_allclose(space.high, env.robot.action_max, atol=1e-4)


def test_a_start_is_a_function_of_the_seed(env):
    digests = []
    for seed in (5, 6, 5):
        env.reset(seed)
        digests.append(env.start_digest())
    assert digests[0] == digests[2] != digests[1]


def test_a_step_draws_nothing_and_a_look_shows_the_cube(env, monkeypatch):
    env.reset(5)
    with monkeypatch.context() as patched:
        patched.setattr(type(env.gymnasium.unwrapped._env.physics), "render", None)
        env.step(env.state())
    picture = env.look()["top"].astype(int)
    assert picture.shape == (24, 32, 3)
    redness = picture[..., 0] - picture[..., 1:].max(axis=2)
    assert redness.max() > 60


@pytest.mark.parametrize("config", ["aloha_transfer", "aloha_insertion"], indirect=True)
def test_the_expert_hands_the_cube_over_and_inserts_the_peg(env, config):
    expert = make_expert(config["task"])
    env.reset(1)
    expert.reset(env, 1)
    step, differs, reached = 0, 0.0, 0
    while not expert.done(env):
        decision = expert.act(env, env.state(), step)
        outcome = env.step(decision.executed)
        reached = max(reached, outcome.stage)
        differs = max(differs, np.abs(decision.executed - decision.action).max())
        step += 1
    assert outcome.success
    assert reached == 4  # peg and pin part again
    assert step <= env.time_limit_steps
    assert 0 < differs < 0.05


def test_a_style_is_a_function_of_the_seed():
    styles = [Style.draw(np.random.default_rng(seed), 1.0) for seed in (1, 1, 2)]
    assert styles[0] == styles[1] != styles[2]
    assert Style.draw(np.random.default_rng(1), 0.0) == Style.draw(np.random.default_rng(2), 0.0)


def test_a_track_is_straight_between_its_waypoints():
    track = Track(np.zeros(3)).until(10, np.array([1.0, 0, 0]), opening=1.0).until(20, opening=0.0)
    np.testing.assert_allclose(track.at(5), [0.5, 0, 0, 1, 0, 0, 0, 0.55])
    np.testing.assert_allclose(track.at(15)[[0, 7]], [1.0, 0.5])
    np.testing.assert_allclose(track.at(99)[[0, 7]], [1.0, 0.0])
    assert track.end == 20


def test_a_usual_episode_fits_into_the_time_limit():
    rng = np.random.default_rng(0)
    ends = [
        max(track.end for track in transfer_tracks(np.zeros(7), Style.draw(rng, 1.0)).values())
        for _ in range(50)
    ]
    assert max(ends) <= 400
