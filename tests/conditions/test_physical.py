"""Conditions of a simulation: what they change, that the start stays, and that an episode leaves nothing behind."""

import mujoco
import numpy as np
import pytest

from imfvla import tasks
from imfvla.conditions import change_of, changed
from imfvla.conditions.change import ChangedWorld
from imfvla.conditions.physical import lowest, objects, simulation
from imfvla.environment import Environment
from imfvla.tasks.props import BAR_WIDTH

PHYSICAL = ("camera_pose", "friction", "mass", "object_size", "bump", "distractors")


@pytest.fixture(scope="module")
def transfer():
    env = tasks.load("transfer", image_size=(32, 32), views=("front", "r_wrist"))
    yield env
    env.close()


def hold(env: Environment, steps: int) -> np.ndarray:
    """Stays where the robot is; returns qpos after every step (steps + 1, nq)."""
    _, data = simulation(env)
    target, places = env.state(), [data.qpos.copy()]
    for _ in range(steps):
        env.step(target)
        places.append(data.qpos.copy())
    return np.array(places)


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    names = [
        name for name in dir(model) if name.startswith(("body_", "geom_", "cam_", "dof_", "jnt_", "light_"))
    ]
    return {
        name: np.array(getattr(model, name)) for name in names if isinstance(getattr(model, name), np.ndarray)
    }


@pytest.mark.parametrize("name", PHYSICAL)
def test_an_episode_depends_on_its_seed_alone_and_starts_as_without_the_condition(name, transfer):
    model, _ = simulation(transfer)
    transfer.reset(7)
    plain, plain_digest = transfer.look(), transfer.start_digest()
    places, before, flags = hold(transfer, 30), arrays(model), int(model.opt.disableflags)
    change = change_of(name)(3)
    env = ChangedWorld(transfer, change)
    played = []
    for seed in (7, 8, 7):
        env.reset(seed)
        played.append((env.start_digest(), env.look(), hold(env, 30), env.look()))
    assert played[0][0] == plain_digest
    for (_, start, ours, end), (_, other_start, others, other_end) in [(played[0], played[2])]:
        np.testing.assert_array_equal(ours, others)
        for view in start:
            np.testing.assert_array_equal(start[view], other_start[view])
            np.testing.assert_array_equal(end[view], other_end[view])
    changes_the_start = name in ("camera_pose", "object_size", "distractors")
    assert changes_the_start != all((played[0][1][view] == plain[view]).all() for view in plain)
    change.end(transfer)
    transfer.reset(7)
    np.testing.assert_array_equal(hold(transfer, 30), places)
    for field, values in before.items():
        np.testing.assert_array_equal(getattr(model, field), values, err_msg=field)
    assert int(model.opt.disableflags) == flags
    if name in ("camera_pose", "distractors"):  # physics is that of the unchanged world
        np.testing.assert_array_equal(played[0][2], places)


@pytest.mark.parametrize("severity", [1, 2, 3])
def test_cameras_are_turned_by_the_angle_and_those_that_stand_moved_by_the_distance(severity, transfer):
    model, _ = simulation(transfer)
    pos, quat = model.cam_pos.copy(), model.cam_quat.copy()
    change = change_of("camera_pose")(severity)
    ChangedWorld(transfer, change).reset(1)
    angles = np.degrees(2 * np.arccos(np.clip(np.abs((quat * model.cam_quat).sum(1)), 0, 1)))
    np.testing.assert_allclose(angles, change.level[1], rtol=1e-3)
    stands = model.body_weldid[model.cam_bodyid] == 0
    np.testing.assert_allclose(
        np.linalg.norm(model.cam_pos - pos, axis=1), np.where(stands, change.level[0], 0)
    )
    assert stands.tolist() == [True, True, False, False]
    change.end(transfer)


def test_a_heavier_object_weighs_on_the_table(transfer):
    model, data = simulation(transfer)
    ((body, _, _),) = objects(model)
    mass = float(model.body_mass[body])
    change = change_of("mass")(2)
    env = ChangedWorld(transfer, change)
    env.reset(3)
    factor = float(model.body_mass[body]) / mass
    assert factor in (pytest.approx(2.5), pytest.approx(1 / 2.5))
    hold(env, 40)
    force, total = np.zeros(6), 0.0
    for number in range(data.ncon):
        if body in model.geom_bodyid[data.contact.geom[number]]:
            mujoco.mj_contactForce(model, data, number, force)
            total += force[0]
    assert total == pytest.approx(factor * mass * 9.81, rel=0.02)
    change.end(transfer)


@pytest.mark.parametrize("name", ["transfer", "socket", "gate"])
def test_a_thicker_object_lies_on_the_table_as_long_as_before(name):
    env = tasks.load(name, image_size=(16, 16), views=("front",))
    model, data = simulation(env)
    for severity in (1, 3):
        for seed in (0, 1, 2):
            world = changed(env, "object_size", severity)
            env.reset(seed)
            resting = {body: lowest(model, data, body) for body, _, _ in objects(model)}
            world.reset(seed)
            for body, _, _ in objects(model):
                assert lowest(model, data, body) == pytest.approx(resting[body], abs=1e-9)
            hold(world, 25)
            for body, _, _ in objects(model):
                assert lowest(model, data, body) == pytest.approx(0, abs=1.5e-3)
            world._change.end(env)
    env.close()


def test_a_bar_is_thicker_across_alone(transfer):
    model, _ = simulation(transfer)
    ((body, _, _),) = objects(model)
    geom = np.flatnonzero(model.geom_bodyid == body)[0]
    before = model.geom_size[geom].copy()
    change = change_of("object_size")(3)
    ChangedWorld(transfer, change).reset(0)
    ratio = model.geom_size[geom] / before
    assert ratio[0] == 1
    assert ratio[1] == ratio[2]
    assert ratio[1] in (pytest.approx(1.25), pytest.approx(1 / 1.25))
    assert before[1] == BAR_WIDTH / 2
    change.end(transfer)


@pytest.mark.parametrize(("severity", "distance"), [(1, 0.03), (2, 0.045), (3, 0.06)])
def test_an_object_is_shifted_once_within_the_approach(severity, distance, transfer):
    env = changed(transfer, "bump", severity)
    env.reset(100_000)
    places = hold(env, 70)
    ((_, position, _),) = objects(simulation(env)[0])
    jumps = np.linalg.norm(np.diff(places[:, position : position + 2], axis=0), axis=1)
    (at,) = np.flatnonzero(jumps > 0.005)
    assert 10 <= at <= 60
    assert jumps[at] == pytest.approx(distance, abs=1e-3)
    assert abs(places[-1, position + 2] - places[0, position + 2]) < 1e-3
    assert env.condition_happened is True
    env.reset(100_001)
    assert env.condition_happened is False


def test_an_object_that_a_hand_touches_is_left_alone(transfer, monkeypatch):
    monkeypatch.setattr("imfvla.conditions.physical._at_rest", lambda *_: False)
    env = changed(transfer, "bump", 3)
    env.reset(100_000)
    places = hold(env, 70)
    assert env.condition_happened is False
    transfer.reset(100_000)
    np.testing.assert_allclose(places, hold(transfer, 70), atol=1e-6)


def test_a_shift_never_ends_in_another_object():
    """In the gate, a bar that was shifted into the post would fail the episode."""
    env = tasks.load("gate", image_size=(16, 16), views=("front",))
    world = changed(env, "bump", 3)
    for seed in range(6):
        world.reset(seed)
        hold(world, 65)
        assert not env.task.failed
    env.close()


def test_distractors_lie_clear_of_the_objects_and_are_gone_after_the_next_reset(transfer):
    transfer.reset(0)
    plain = transfer.look()["front"]
    env = changed(transfer, "distractors", 3)
    env.reset(0)
    assert (env.look()["front"] != plain).any(axis=-1).mean() > 0.005
    bar = transfer.task.prop_pose(transfer.physics, "bar").position[:2]
    assert len(transfer._distractors) == 7
    assert min(np.linalg.norm(shape.position[:2] - bar) for shape in transfer._distractors) > 0.13
    transfer.reset(0)
    np.testing.assert_array_equal(transfer.look()["front"], plain)
