"""Inverse kinematics of one arm: damped least squares on a private copy of the simulation's data."""

import math

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
        data = self._data = mujoco.MjData(model)
        self._site = model.site(f"{side}/grip").id
        joints = [model.joint(f"{side}/joint_{i}").id for i in range(1, 8)]
        self._qpos = model.jnt_qposadr[joints]
        self._dofs = model.jnt_dofadr[joints]
        low, high = model.jnt_range[joints].T
        self._limits = list(zip(low.tolist(), high.tolist(), strict=True))
        self._jacobian = np.zeros((6, model.nv))
        # Views of the simulation's memory and results of `solve`, made once: with 6 and 7 numbers, making arrays costs
        # more than computing them.
        self._position, self._rotation = data.site_xpos[self._site], data.site_xmat[self._site]
        self._rows = self._jacobian[:3], self._jacobian[3:]
        self._normal, self._reduced = np.zeros((6, 6)), np.zeros(6)
        self._damping = DAMPING**2 * np.eye(6)

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
        joints = np.asarray(start, dtype=np.float64).tolist()
        position, rotation = target.position.tolist(), target.rotation.ravel().tolist()
        for _ in range(max_iterations):
            self._data.qpos[self._qpos] = joints
            mujoco.mj_kinematics(self._model, self._data)
            away = [wanted - here for wanted, here in zip(position, self._position.tolist(), strict=True)]
            away += _turn(rotation, self._rotation.tolist())
            if max(map(abs, away)) < TOLERANCE and abs(joints[2]) < 2e-3:
                break
            mujoco.mj_comPos(self._model, self._data)
            jacobian = self._jacobian_here()
            back = -STRAIGHTEN * joints[2]
            np.add(jacobian @ jacobian.T, self._damping, out=self._normal)
            mujoco.mju_cholFactor(self._normal, 0.0)
            mujoco.mju_cholSolve(self._reduced, self._normal, away - jacobian[:, 2] * back)
            step = (self._reduced @ jacobian).tolist()
            step[2] += back
            scale = min(1.0, MAX_TURN / max(map(abs, step)))
            joints = [
                min(max(angle + scale * turn, low), high)
                for angle, turn, (low, high) in zip(joints, step, self._limits, strict=True)
            ]
        return np.array(joints)

    def _place(self, joints: np.ndarray) -> None:
        self._data.qpos[self._qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def _jacobian_here(self) -> np.ndarray:
        mujoco.mj_jacSite(self._model, self._data, *self._rows, self._site)
        return self._jacobian[:, self._dofs]


def _turn(target: list[float], here: list[float]) -> list[float]:
    """`rotation_vector` of target @ here.T, both with 9 numbers by rows."""
    (a, b, c), (d, e, f), (g, h, i) = target[:3], target[3:6], target[6:]
    (j, k, m), (n, o, p), (q, r, s) = here[:3], here[3:6], here[6:]
    x = g * n + h * o + i * p - (d * q + e * r + f * s)
    y = a * q + b * r + c * s - (g * j + h * k + i * m)
    z = d * j + e * k + f * m - (a * n + b * o + c * p)
    norm = math.sqrt(x * x + y * y + z * z)
    if norm < 1e-9:
        return [x / 2, y / 2, z / 2]
    trace = a * j + b * k + c * m + d * n + e * o + f * p + g * q + h * r + i * s
    share = math.atan2(norm, trace - 1) / norm
    return [x * share, y * share, z * share]


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
