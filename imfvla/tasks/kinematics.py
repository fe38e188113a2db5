"""Inverse kinematics of one arm: damped least squares on a private copy of the simulation's data."""

import mujoco
import numpy as np

from imfvla.tasks.bimanual import Pose

DAMPING = 0.02
MAX_TURN = 0.25  # rad a joint may turn in one iteration
TOLERANCE = 2e-4  # m and rad
STRAIGHTEN = 0.3  # share of joint 3's angle that is taken back in one iteration


class ArmKinematics:
    """Joint angles that bring the grip frame of one arm to a pose.

    Seven joints leave the elbow free to swing; it is brought back into the vertical plane (joint 3 to zero), so that
    the solution near the start posture is a smooth function of the pose and does not depend on the way there.
    """

    def __init__(self, model: mujoco.MjModel, side: str) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._site = model.site(f"{side}/grip").id
        joints = [model.joint(f"{side}/joint_{i}").id for i in range(1, 8)]
        self._qpos = model.jnt_qposadr[joints]
        self._dofs = model.jnt_dofadr[joints]
        self._low, self._high = model.jnt_range[joints].T
        self._jacobian = np.zeros((6, model.nv))

    def pose(self, joints: np.ndarray) -> Pose:
        """Grip frame at the joint angles (7,) [rad]."""
        self._place(joints)
        return Pose(
            self._data.site_xpos[self._site].copy(), self._data.site_xmat[self._site].reshape(3, 3).copy()
        )

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        """Derivative (6, 7) of the grip frame: velocity and angular velocity in the world per joint velocity."""
        self._place(joints)
        return self._jacobian_here()

    def solve(self, target: Pose, start: np.ndarray, max_iterations: int = 30) -> np.ndarray:
        """Joint angles (7,) within the limits whose grip frame is nearest to `target`, searched from `start` (7,)."""
        joints = np.array(start, dtype=np.float64)
        for _ in range(max_iterations):
            self._place(joints)
            error = np.concatenate(
                [
                    target.position - self._data.site_xpos[self._site],
                    rotation_vector(target.rotation @ self._data.site_xmat[self._site].reshape(3, 3).T),
                ]
            )
            if np.abs(error).max() < TOLERANCE and abs(joints[2]) < 2e-3:
                break
            jacobian = self._jacobian_here()
            inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(6))
            back = np.zeros(7)
            back[2] = -STRAIGHTEN * joints[2]
            step = inverse @ (error - jacobian @ back) + back
            joints = np.clip(joints + step * min(1.0, MAX_TURN / np.abs(step).max()), self._low, self._high)
        return joints

    def _place(self, joints: np.ndarray) -> None:
        self._data.qpos[self._qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def _jacobian_here(self) -> np.ndarray:
        mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._site)
        return self._jacobian[:, self._dofs]


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Axis times angle (3,) [rad] of a rotation (3, 3) of less than half a turn."""
    twice_sine = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    norm = np.linalg.norm(twice_sine)
    if norm < 1e-9:
        return twice_sine / 2
    return twice_sine / norm * np.arctan2(norm, np.trace(rotation) - 1)


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by axis times angle (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def about_z(yaw: float) -> np.ndarray:
    """Rotation (3, 3) by `yaw` [rad] about the world's z axis."""
    return rotation_matrix(np.array([0.0, 0.0, yaw]))


def yaw_of(rotation: np.ndarray) -> float:
    """Angle [rad] in (-pi, pi] of the frame's x axis about the world's z axis."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))
