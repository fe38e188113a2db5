"""Conditions for any environment: drawn from the seed alone, and what each of them does."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from fakes import ROBOT, FakeEnvironment, PlainEnvironment, fake_robot

from imfvla.command.composition import compose
from imfvla.conditions import CHANGES, change_of, changed
from imfvla.config.condition import CONDITIONS, ConditionOptions
from imfvla.config.protocol import EvaluationOptions
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.robot import Camera
from imfvla.storage.run_names import run_name

GENERIC = ("light", "pixel_noise", "blur", "dropped_frames", "joint_bias", "action_lag")
PHYSICAL = ("camera_pose", "friction", "mass", "object_size", "bump")


def world(name: str, severity: int = 2, robot=ROBOT):
    return changed(FakeEnvironment(60, robot=robot), name, severity)


def play(env, seed: int, looks=range(60), steps: int = 60) -> dict[int, tuple]:
    """What is seen and felt at the steps `looks`, while every action tells its step."""
    env.reset(seed)
    seen = {}
    for step in range(steps):
        if step in looks:
            seen[step] = (env.look(), env.state())
        env.step(np.full(len(env.robot.action), step / 60, np.float32))
    return seen


def assert_equal(ours: dict[int, tuple], theirs: dict[int, tuple]) -> None:
    for step in ours.keys() & theirs.keys():
        for view, picture in ours[step][0].items():
            np.testing.assert_array_equal(picture, theirs[step][0][view])
        np.testing.assert_array_equal(ours[step][1], theirs[step][1])


def is_equal(ours: dict[int, tuple], theirs: dict[int, tuple]) -> bool:
    try:
        assert_equal(ours, theirs)
    except AssertionError:
        return False
    return True


def test_every_condition_has_its_class_its_levels_and_its_file():
    folder = Path(__file__).parents[2] / "conf" / "condition"
    assert set(CONDITIONS) == set(CHANGES) == {path.stem for path in folder.glob("*.yaml")} - {"none"}
    for name in CONDITIONS:
        assert len(change_of(name).LEVELS) == 3
        assert yaml.safe_load((folder / f"{name}.yaml").read_text()) == {"name": name, "severity": 2}


def test_no_condition_is_the_environment_itself():
    env = FakeEnvironment()
    assert changed(env, "none", None) is env


@pytest.mark.parametrize("name", GENERIC)
def test_a_condition_depends_on_the_seed_alone(name):
    env = world(name)
    first = play(env, 3)
    assert_equal(first, play(env, 3, looks=range(0, 60, 16)))  # another policy looks less often
    if name not in ("action_lag", "blur"):  # which draw nothing
        assert not is_equal(first, play(env, 4))
    assert_equal(first, play(env, 3))  # whatever was played before
    assert_equal(first, play(world(name), 3))
    assert env.start_digest() == f"{3:016x}"


@pytest.mark.parametrize("name", GENERIC)
@pytest.mark.parametrize("sizes", [(7, 7, 1), (8, 9, 2)])
def test_any_robot_and_any_camera_will_do(name, sizes):
    states, actions, cameras = sizes
    robot = fake_robot(states, actions, tuple(Camera(f"c{i}", 12 + 4 * i, 20) for i in range(cameras)), 10.0)
    for severity in (1, 2, 3):
        for pictures, state in play(world(name, severity, robot), 1).values():
            assert {view: (p.shape, p.dtype) for view, p in pictures.items()} == {
                camera.name: ((camera.height, camera.width, 3), np.uint8) for camera in robot.cameras
            }
            assert (state.shape, state.dtype) == ((states,), np.float32)


def test_light_scales_every_colour_by_one_factor():
    seen, plain = play(world("light", 2), 5), play(FakeEnvironment(60), 5)
    factors = []
    for step in (0, 30):
        ours, theirs = (float(found[step][0]["top"][8, 8, 1]) for found in (seen, plain))
        factors.append(ours / theirs)
    assert factors[0] == pytest.approx(factors[1], abs=0.02)
    assert any(factors[0] == pytest.approx(way, rel=0.12) for way in (1.3, 1 / 1.3))


def test_pixel_noise_differs_between_steps_and_not_between_looks():
    env = world("pixel_noise", 1)
    env.reset(0)
    once, again = env.look()["top"], env.look()["top"]
    np.testing.assert_array_equal(once, again)
    plain = FakeEnvironment(60)
    plain.reset(0)
    error = once.astype(float) - plain.look()["top"]
    assert 6 < error[4:].std() < 10
    env.step(np.zeros(16, np.float32))
    assert not np.array_equal(env.look()["top"][8], once[8])


def test_a_blurred_edge_is_wider_with_severity():
    steepest = []
    for severity in (1, 2, 3):
        picture = play(world("blur", severity, fake_robot(cameras=(Camera("c", 96, 96),))), 0)[0][0]["c"]
        steepest.append(np.abs(np.diff(picture[48, :, 0].astype(int))).max())
    assert 160 > steepest[0] > steepest[1] > steepest[2]


@pytest.mark.parametrize(("severity", "length"), [(1, 5), (2, 10), (3, 20)])
def test_frames_are_those_of_the_moment_at_which_the_cameras_stalled(severity, length):
    seen = play(world("dropped_frames", severity), 2)
    shown = [
        256 * int(pictures["top"][0, 0, 0]) + int(pictures["top"][0, 1, 0]) for pictures, _ in seen.values()
    ]
    stalls = [step for step in range(60) if shown[step] != step]
    assert stalls
    assert all(0 <= step - shown[step] < length for step in range(60))
    began = {shown[step] for step in stalls}
    assert all(
        shown[start : start + length] == [start] * len(shown[start : start + length]) for start in began
    )


def test_sensors_are_off_by_one_constant_within_their_share():
    seen, plain = play(world("joint_bias", 3), 9), play(FakeEnvironment(60), 9)
    bias = np.array([seen[step][1] - plain[step][1] for step in seen])
    np.testing.assert_allclose(bias, np.broadcast_to(bias[0], bias.shape), atol=1e-5)
    assert (np.abs(bias[0]) <= 0.02 * 8 + 1e-6).all()  # of actions between -4 and 4
    assert (np.abs(bias[0]) >= 0.01 * 8 - 1e-6).all()


@pytest.mark.parametrize(("severity", "lag"), [(1, 2), (2, 4), (3, 8)])
def test_actions_are_applied_late(severity, lag):
    env = FakeEnvironment(60)
    play(changed(env, "action_lag", severity), 0)
    applied = 60 * np.array(env.executed)[:, 0]
    np.testing.assert_allclose(applied, [max(0, step - lag) for step in range(60)], atol=1e-4)


@pytest.mark.parametrize("name", [*PHYSICAL, "distractors"])
@pytest.mark.parametrize("env", [PlainEnvironment(), FakeEnvironment()], ids=["no bodies", "other bodies"])
def test_what_an_environment_lacks_is_said_with_the_conditions_name(name, env):
    with pytest.raises(
        UserError, match=rf"condition={name} needs a .*, which the environment fake does not have"
    ):
        changed(env, name, 1)


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        (
            {"name": "fog", "severity": 1},
            r"condition\.name must be one of none, camera_pose, .*, found 'fog'",
        ),
        ({"name": "blur", "severity": 4}, r"condition\.severity must be null or between 1 and 3, found 4"),
        ({"name": "blur", "severity": 0}, r"between 1 and 3"),
        (
            {"name": "blur", "severity": None},
            r"condition\.severity must be 1, 2 or 3 with condition=blur, found None",
        ),
        ({"name": "none", "severity": 2}, r"condition\.severity must be null with condition=none, found 2"),
    ],
)
def test_wrong_conditions_are_named(condition, message):
    with pytest.raises(UserError, match=message):
        build(EvaluationOptions, {"episodes": 1, "first_seed": 0, "nfe": [1], "condition": condition}, "")


def test_the_group_is_chosen_alike_in_training_and_evaluation():
    found = compose("train", ["condition=bump", "evaluation.condition.severity=3"])["evaluation"]["condition"]
    assert found == compose("evaluate", ["condition=bump", "condition.severity=3"])["condition"]
    assert build(ConditionOptions, found, "") == ConditionOptions("bump", 3)
    assert run_name(["+exp=x", "condition=bump", "evaluation.condition.severity=3"]) == "default"
    assert compose("train", [])["evaluation"]["condition"] == {"name": "none", "severity": None}
