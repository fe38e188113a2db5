import json
from pathlib import Path

import numpy as np
import pytest

from imfvla import tasks
from imfvla.environment import Outcome
from imfvla.errors import UserError
from imfvla.robot import bare_name
from imfvla.tasks.experts import make_expert

NUM_STAGES = {"socket": 5, "transfer": 4, "either_arm": 5, "gate": 4}


def hold_still(env) -> np.ndarray:
    return env.state()


def test_specs(env):
    env.reset(0)
    state = env.state()
    assert (state.shape, state.dtype) == ((16,), np.float32)
    assert (len(env.robot.state), len(env.robot.action), env.robot.control_hz) == (16, 16, 50)
    assert env.time_limit_steps == 700
    goal = env.goal or env.name
    assert len(env.stages) == NUM_STAGES[goal]
    assert env.instruction == tasks.text_for(goal)[0]
    assert len(env.paraphrases) >= 3


def test_the_robot_is_the_one_that_is_simulated(env):
    model, robot = env.physics.model, env.robot
    assert [model.id2name(i, "actuator") for i in range(model.nu)] == [bare_name(n) for n in robot.action]
    np.testing.assert_allclose(model.actuator_ctrlrange, np.transpose([robot.action_min, robot.action_max]))
    assert env.task.control_timestep == pytest.approx(1 / robot.control_hz)


def test_each_action_entry_moves_its_own_state_entry(env):
    env.reset(0)
    start = env.state()
    target = start + np.where(np.arange(16) % 8 == 7, -0.2, 0.05)
    for _ in range(60):
        env.step(target)
    np.testing.assert_allclose(env.state(), target, atol=6e-3)


def test_the_start_depends_on_the_seed_alone(env):
    env.reset(3)
    digest, state, qpos = env.start_digest(), env.state(), np.array(env.physics.data.qpos)
    for seed in (4, 5):
        env.reset(seed)
        assert env.start_digest() != digest
        for _ in range(7):
            env.step(np.array(env.robot.action_max))
    env.reset(3)
    assert env.start_digest() == digest
    assert len(digest) == 16
    np.testing.assert_array_equal(env.state(), state)
    np.testing.assert_array_equal(env.physics.data.qpos, qpos)


def test_an_episode_repeats_whatever_was_done_before(env):
    def play() -> list[np.ndarray]:
        env.reset(8)
        expert = make_expert(env.name, modes=2, noise=0.01, hold=18, dwell=0)
        expert.reset(env, 8)
        states = []
        for step in range(60):
            env.step(expert.act(env, env.state(), step).executed)
            states.append(env.state())
        return states

    first = play()
    env.reset(9)
    env.step(np.array(env.robot.action_min))
    np.testing.assert_array_equal(first, play())


@pytest.mark.parametrize("name", NUM_STAGES)
@pytest.mark.parametrize("variant", tasks.VARIANTS)
def test_starts_lie_in_the_declared_ranges_apart_and_at_rest(name, variant):
    env = tasks.load(name, variant=variant)
    poses = {prop: [] for prop in env.task.props}
    for seed in range(60):
        env.reset(seed)
        assert env.stage() == 0
        assert {tuple(sorted(pair)) for pair in env.task.contacts(env.physics).tolist()} <= touching_table(
            env
        )
        for prop in poses:
            pose = env.task.prop_pose(env.physics, prop)
            poses[prop].append([*pose.position[:2], np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])])
    for prop, found in poses.items():
        limits = env.task.ranges[prop]
        low, high = np.min(found, axis=0), np.max(found, axis=0)
        for index, (least, most) in enumerate((limits.x, limits.y, limits.yaw)):
            assert least <= low[index] <= high[index] <= most
            assert high[index] - low[index] >= 0.8 * (most - least)
    env.close()


def touching_table(env) -> set[tuple[int, int]]:
    model = env.physics.model
    table = model.name2id("table", "geom")
    return {tuple(sorted((table, geom))) for geom in range(model.ngeom)}


@pytest.mark.parametrize("name", ["socket", "transfer"])
def test_default_ranges_are_wide(name):
    for limits in tasks.load(name).task.ranges.values():
        sides = sorted(most - least for least, most in (limits.x, limits.y))
        assert sides[0] >= 0.2 - 1e-9
        assert sides[1] >= 0.25 - 1e-9
        assert limits.yaw[0] <= -np.pi / 6
        assert limits.yaw[1] >= np.pi / 6


def test_socket_and_peg_are_drawn_independently(socket_env):
    drawn = []
    for seed in range(150):
        socket_env.reset(seed)
        poses = [socket_env.task.prop_pose(socket_env.physics, name) for name in ("socket", "peg")]
        drawn.append([v for p in poses for v in (*p.position[:2], p.rotation[1, 0])])
    correlation = np.corrcoef(np.transpose(drawn))[:3, 3:]
    assert np.abs(correlation).max() < 0.3


def test_objects_at_rest_stay_where_they_are(env):
    env.reset(1)
    before = {name: env.task.prop_pose(env.physics, name).position for name in env.task.props}
    for _ in range(100):
        env.step(hold_still(env))
    for name, position in before.items():
        np.testing.assert_allclose(env.task.prop_pose(env.physics, name).position, position, atol=2e-3)


def test_the_700th_step_is_the_last(env):
    env.reset(0)
    action = env.state()
    assert [env.step(action).ended for _ in range(700)] == [False] * 699 + [True]


def test_a_world_that_flies_apart_ends_the_episode_early(env):
    env.reset(0)
    env.physics.data.qvel[:] = 1e12
    assert env.step(np.array(env.robot.action_max)) == Outcome(0.0, 0, success=False, ended=True)
    env.reset(0)
    assert np.isfinite(env.state()).all()


@pytest.mark.parametrize("action", [np.full(16, np.nan), np.r_[np.inf, np.zeros(15)], np.zeros(15)])
def test_a_bad_action_is_refused(env, action):
    env.reset(0)
    with pytest.raises(UserError, match="16 finite numbers"):
        env.step(action)


def test_actions_beyond_the_limits_do_no_more_than_the_limits(env):
    states = []
    for factor in (1, 1000):
        env.reset(2)
        for _ in range(20):
            env.step(np.array(env.robot.action_max) * factor)
        states.append(env.state())
    np.testing.assert_allclose(*states, atol=1e-6)


def test_cameras_are_rendered_only_when_someone_looks(env, monkeypatch):
    env.reset(0)
    monkeypatch.setattr(type(env), "render", lambda *a: pytest.fail("rendered"))
    env.step(env.state())


def test_views_show_the_objects_in_their_colours(env):
    """Vivid orange is the bar's; the socket is blue. Both are seen from above and in front at any start."""
    for seed in range(4):
        env.reset(seed)
        pictures = env.look()
        assert tuple(pictures) == env.views
        for view in ("front", "top"):
            assert pictures[view].shape == (48, 48, 3)
            assert pictures[view].dtype == np.uint8
            red, green, blue = pictures[view].astype(int).transpose(2, 0, 1)
            assert ((red > green + 50) & (green > blue + 30)).sum() >= 8, view
            if env.name == "socket":
                assert ((blue > red + 60) & (blue > green + 60)).sum() >= 8, view


def test_pictures_of_a_state_repeat_and_any_size_goes(env):
    env.reset(1)
    before = {view: env.render(view, *env.image_size) for view in env.all_views}
    assert env.render("top", 31, 57).shape == (31, 57, 3)
    for view, picture in before.items():
        np.testing.assert_array_equal(env.render(view, *env.image_size), picture)


def test_the_bar_looks_the_same_turned_by_half_a_turn(transfer_env):
    transfer_env.reset(0)
    before = transfer_env.look()
    start = transfer_env.task._ids.free["bar"] + 3
    with transfer_env.physics.reset_context():
        transfer_env.task.initialize_episode(transfer_env.physics, np.random.RandomState(0))
        quat = transfer_env.physics.data.qpos[start : start + 4].copy()
        transfer_env.physics.data.qpos[start : start + 4] = [-quat[3], 0, 0, quat[0]]
    for view, picture in transfer_env.look().items():
        difference = np.abs(picture.astype(int) - before[view]).max(axis=-1)
        assert (difference > 20).mean() < 2e-3, view  # edges may round differently


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "juggling"}, "no task 'juggling'"),
        ({"name": "socket", "variant": "brutal"}, "task.variant must be one of easy, default, hard"),
        ({"name": "socket", "views": ("front", "r_vis")}, "no view 'r_vis'"),
    ],
)
def test_mistakes_in_loading_are_named(arguments, message):
    with pytest.raises(UserError, match=message):
        tasks.load(**arguments)


@pytest.mark.parametrize("name", ["socket", "transfer"])
def test_committed_evaluations_began_where_their_seeds_begin_now(name):
    run = (
        Path(__file__).parents[2]
        / "experiments"
        / "pretrained"
        / f"{name}_ph32_exec16"
        / "generator=imf_plain"
    )
    lines = next(run.glob("rollouts/*/episodes.jsonl")).read_text().splitlines()
    env = tasks.load(name)
    for row in map(json.loads, lines[:3]):
        env.reset(row["seed"])
        assert env.start_digest() == row["start_digest"]
    env.close()
