import numpy as np
import pytest

from imfvla.tasks.bimanual import Pose
from imfvla.tasks.kinematics import ArmKinematics, about_z, rotation_matrix, rotation_vector, yaw_of
from imfvla.tasks.robot import HOME_HEIGHT, HOME_REACH, JOINT_LIMITS, home_joints
from imfvla.tasks.scene import BASE_X

SIDES = ("left", "right")


@pytest.fixture(params=SIDES)
def arm(request, transfer_env) -> ArmKinematics:
    return ArmKinematics(transfer_env.physics.model.ptr, request.param)


def sign_of(arm: ArmKinematics) -> float:
    return float(np.sign(arm.pose(home_joints()).position[0]))


def test_home_points_down_with_a_frame_like_the_worlds(arm):
    pose = arm.pose(home_joints())
    x = sign_of(arm) * (BASE_X - HOME_REACH)
    np.testing.assert_allclose(pose.position, [x, 0, HOME_HEIGHT], atol=1e-9)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-9)


def test_jacobian_agrees_with_finite_differences(arm):
    rng = np.random.default_rng(0)
    joints = home_joints() + rng.uniform(-0.4, 0.4, 7)
    jacobian = arm.jacobian(joints)
    step = 1e-6
    for index in range(7):
        ahead, behind = (arm.pose(joints + sign * step * np.eye(7)[index]) for sign in (1, -1))
        velocity = (ahead.position - behind.position) / (2 * step)
        turning = rotation_vector(ahead.rotation @ behind.rotation.T) / (2 * step)
        np.testing.assert_allclose(jacobian[:, index], [*velocity, *turning], atol=1e-6)


def test_solutions_reach_the_workspace_with_the_elbow_upright_and_limits_kept(arm):
    rng = np.random.default_rng(1)
    low, high = np.transpose(JOINT_LIMITS)
    for _ in range(20):
        position = rng.uniform([0.0, -0.15, 0.01], [0.3, 0.15, 0.25]) * [sign_of(arm), 1, 1]
        target = Pose(position, about_z(rng.uniform(-2.2, 2.2)))
        joints = arm.solve(target, home_joints(), max_iterations=100)
        reached = arm.pose(joints)
        np.testing.assert_allclose(reached.position, target.position, atol=1e-3)
        assert np.linalg.norm(rotation_vector(target.rotation @ reached.rotation.T)) < 2e-3
        assert abs(joints[2]) < 0.01
        assert ((joints > low) & (joints < high)).all()


def test_a_solution_does_not_depend_on_the_way_there(arm):
    target = Pose(np.array([0.15 * sign_of(arm), 0.1, 0.05]), about_z(1.2))
    direct = arm.solve(target, home_joints(), max_iterations=100)
    twisted = home_joints() + [0.2, 0.1, 0.5, -0.2, 0.3, 0.1, -0.3]
    np.testing.assert_allclose(arm.solve(target, twisted, max_iterations=200), direct, atol=5e-3)


def test_rotation_vectors_and_matrices_are_inverse():
    rng = np.random.default_rng(2)
    for length in (0.0, 1e-12, 1e-4, 0.5, 3.0):
        vector = rng.standard_normal(3)
        vector *= length / np.linalg.norm(vector)
        np.testing.assert_allclose(rotation_vector(rotation_matrix(vector)), vector, atol=1e-9)
    assert yaw_of(about_z(-2.5)) == pytest.approx(-2.5)


def plainly_solved(arm: ArmKinematics, target: Pose, joints: np.ndarray) -> np.ndarray:
    """Damped least squares, written as in the formula."""
    low, high = np.array(arm._limits).T
    for _ in range(30):
        here, jacobian = arm.pose(joints), arm.jacobian(joints)
        error = np.append(target.position - here.position, rotation_vector(target.rotation @ here.rotation.T))
        if np.abs(error).max() < 2e-4 and abs(joints[2]) < 2e-3:
            break
        back = np.array([0, 0, -0.3 * joints[2], 0, 0, 0, 0])
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + 0.02**2 * np.eye(6))
        step = inverse @ (error - jacobian @ back) + back
        joints = np.clip(joints + step * min(1.0, 0.25 / np.abs(step).max()), low, high)
    return joints


def test_solutions_are_those_of_the_plain_formula(arm):
    rng, home = np.random.default_rng(0), arm.pose(home_joints())
    for _ in range(20):
        target = Pose(
            home.position + rng.uniform(-0.1, 0.1, 3),
            rotation_matrix(rng.uniform(-0.6, 0.6, 3)) @ home.rotation,
        )
        start = home_joints() + rng.uniform(-0.2, 0.2, 7)
        assert arm.solve(target, start) == pytest.approx(plainly_solved(arm, target, start), abs=1e-9)
