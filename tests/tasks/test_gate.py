"""What makes the gate a task on which averages fail: its ways part within one chunk, and between them is a post."""

from collections.abc import Iterator

import numpy as np
import pytest

from imfvla import tasks
from imfvla.tasks.bimanual_environment import BimanualEnvironment
from imfvla.tasks.experts.gate import GATE, WAYS, GateExpert
from imfvla.tasks.gate import BAR_LENGTH
from imfvla.tasks.props import POST_RADIUS

SEED = 4
CHUNK = 16  # executed steps


@pytest.fixture(scope="module")
def gate_env() -> Iterator[BimanualEnvironment]:
    env = tasks.load("gate", variant="easy", image_size=(96, 96))
    yield env
    env.close()


@pytest.fixture(scope="module")
def played(gate_env) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """An episode of each way from the same start; the post stands where it stood."""
    return {way: play(gate_env, way) for way in WAYS}


def play(env: BimanualEnvironment, way: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions, places of the bar's middle and stages of an episode in which the expert goes this way."""
    expert = GateExpert(modes=1, noise=0.0, hold=18, dwell=0)
    env.reset(SEED)
    expert.reset(env, SEED)
    expert.way = way
    actions, places, stages = [], [], []
    for step in range(400):
        places.append(env.task.prop_pose(env.physics, "bar").position)
        actions.append(expert.act(env, env.state(), step).executed)
        env.step(actions[-1])
        stages.append(env.stage())
        if expert.done(env) or (stages[-10:] == 10 * [0] and max(stages) > 1):
            break
    return np.array(actions), np.array(places), np.array(stages)


def test_all_ways_are_one_until_the_gate_and_have_parted_a_chunk_later(gate_env, played):
    post = gate_env.task.prop_pose(gate_env.physics, "post").position
    actions, places, _ = played["left"]
    gap = places[:, 0] - BAR_LENGTH / 2 - post[0] - POST_RADIUS
    parts = int(np.flatnonzero((places[:, 2] > 0.1) & (gap < GATE + 0.02))[0])
    assert gap[parts + CHUNK] < 0.01
    for other_actions, other_places, _ in played.values():
        np.testing.assert_array_equal(other_actions[:parts], actions[:parts])
        np.testing.assert_array_equal(other_places[: parts + 1], places[: parts + 1])
    after = [places[parts + CHUNK] for _, places, _ in played.values()]
    assert min(np.linalg.norm(a - b) for i, a in enumerate(after) for b in after[:i]) > 0.03


def test_every_way_is_taken_equally_often_and_the_seed_tells_which():
    expert = GateExpert(modes=1, noise=0.0, hold=18, dwell=0)
    ways = [expert.draw_style(np.random.default_rng(seed))["way"] for seed in range(600)]
    assert set(ways) == set(WAYS)
    assert all(ways.count(way) == pytest.approx(200, abs=40) for way in WAYS)


def test_mean_and_median_of_the_ways_run_into_the_post_and_that_is_the_end(gate_env, monkeypatch):
    ways = np.array(list(WAYS.values()))
    np.testing.assert_allclose(ways.mean(axis=0), 0, atol=1e-9)
    for average in (ways.mean(axis=0), np.median(ways, axis=0)):
        monkeypatch.setitem(WAYS, "average", average)
        _, _, stages = play(gate_env, "average")
        touched = int(np.flatnonzero(stages >= 2)[-1]) + 1
        assert gate_env.task.touched_post
        assert not gate_env.step(gate_env.state()).success
        assert stages.max() < len(gate_env.stages)
        assert not stages[touched:].any()


def test_every_way_passes_without_a_touch(gate_env, played):
    post = gate_env.task.prop_pose(gate_env.physics, "post")
    for _, places, stages in played.values():
        assert stages[-1] == len(gate_env.stages)
        assert places[-1][0] + BAR_LENGTH / 2 < post.position[0]


def test_a_touch_is_forgotten_at_the_next_reset(gate_env):
    gate_env.reset(0)
    gate_env.task.touched_post = True
    gate_env.reset(0)
    assert not gate_env.task.touched_post


def test_a_touch_after_the_last_stage_undoes_the_success(gate_env):
    play(gate_env, "left")
    assert gate_env.step(gate_env.state()).success
    gate_env.task.touched_post = True
    assert not gate_env.step(gate_env.state()).success


def test_the_post_is_seen_from_everywhere_it_matters(gate_env):
    for seed in range(3):
        gate_env.reset(seed)
        for view, least in (("front", 12), ("top", 20)):
            red, green, blue = gate_env.look()[view].astype(int).transpose(2, 0, 1)
            assert ((red > green + 60) & (blue > green + 30)).sum() >= least, view
