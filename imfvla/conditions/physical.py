"""Conditions of bodies and cameras, for environments that show a MuJoCo simulation (`environment.bodies_of`).

An object is a body with a free joint; a hand is any body that is neither an object nor fixed to the world. Changes of
the model are applied after the start state has been set, and taken back before the next episode.
"""

from typing import ClassVar

import mujoco
import numpy as np

from imfvla.conditions.change import Change, either_way
from imfvla.environment import Environment, bodies_of

# Kinds of geoms whose extent is known.
BOX, CYLINDER, CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)


class _Simulated(Change):
    """A change of a simulation. FIELDS of the model that it changes."""

    FIELDS: ClassVar[tuple[str, ...]] = ()

    def __init__(self, severity: int) -> None:
        super().__init__(severity)
        self._kept: dict[str, np.ndarray] = {}

    def lacking(self, env: Environment) -> str | None:
        bodies = bodies_of(env)
        known = bodies is not None and isinstance(_raw(bodies.model), mujoco.MjModel)
        return None if known else "a MuJoCo simulation (`scene`)"

    def end(self, env: Environment) -> None:
        model, _ = simulation(env)
        for field, values in self._kept.items():
            getattr(model, field)[:] = values

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        model, data = simulation(env)
        if not self._kept:
            self._kept = {field: getattr(model, field).copy() for field in self.FIELDS}
        self.alter(model, data, rng)
        mujoco.mj_forward(model, data)

    def alter(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Changes the model for one episode."""


class CameraPose(_Simulated):
    """Every camera is turned about a drawn axis; those that stand are moved too. Those on a hand are only turned."""

    LEVELS = ((0.01, 1.0), (0.02, 2.0), (0.04, 4.0))  # m, degrees
    FIELDS = ("cam_pos", "cam_quat")

    def alter(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        distance, angle = self.level
        for camera in range(model.ncam):
            axis, direction = _direction(rng), _direction(rng)
            turn = np.array([np.cos(np.radians(angle) / 2), *(np.sin(np.radians(angle) / 2) * axis)])
            mujoco.mju_mulQuat(model.cam_quat[camera], model.cam_quat[camera].copy(), turn)
            if model.body_weldid[model.cam_bodyid[camera]] == 0:
                model.cam_pos[camera] += distance * direction


class Friction(_Simulated):
    """Everything is more slippery: all coefficients of friction times `level`."""

    LEVELS = (0.7, 0.5, 0.3)
    FIELDS = ("geom_friction",)

    def alter(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        model.geom_friction[:] *= self.level


class Mass(_Simulated):
    """Objects are heavier or lighter by a factor."""

    LEVELS = (1.5, 2.5, 4.0)
    FIELDS = (
        "body_mass",
        "body_inertia",
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "dof_M0",
    )

    def alter(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        factor = either_way(self.level, rng)
        for body, _, dof in objects(model):
            model.body_subtreemass[0] += (factor - 1) * model.body_mass[body]
            for of_body in (model.body_mass, model.body_inertia, model.body_subtreemass):
                of_body[body] *= factor
            model.body_invweight0[body] /= factor
            model.dof_invweight0[dof : dof + 6] /= factor
            model.dof_M0[dof : dof + 6] *= factor


class ObjectSize(_Simulated):
    """Objects are thicker or thinner by a factor, at the same length along their x axis and the same mass."""

    LEVELS = (1.08, 1.16, 1.25)
    FIELDS = ("geom_pos", "geom_size", "geom_rbound")

    def alter(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
        factor = either_way(self.level, rng)
        self._flags = int(model.opt.disableflags)
        # Boxes around parts of a body are made when a model is compiled; without them all of its geoms are compared.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        for body, position, _ in objects(model):
            rested_at = lowest(model, data, body)
            for geom in np.flatnonzero(model.geom_bodyid == body):
                model.geom_pos[geom, 1:] *= factor
                model.geom_rbound[geom] *= max(1.0, factor)
                is_box = model.geom_type[geom] == BOX
                across = _across(model, geom) if is_box else slice(None)
                model.geom_size[geom, across] *= factor
            mujoco.mj_kinematics(model, data)
            data.qpos[position + 2] += rested_at - lowest(model, data, body)

    def end(self, env: Environment) -> None:
        super().end(env)
        if self._kept:
            simulation(env)[0].opt.disableflags = self._flags


class Bump(_Simulated):
    """Once in the approach an object that no hand touches is shifted on what it lies on, by `level`.

    Moment, direction and object are drawn; a direction in which it would meet something is turned by an eighth.
    Nothing happens where all objects are held at that moment; rows say whether it did.
    """

    LEVELS = (0.03, 0.045, 0.06)  # m
    BETWEEN = (0.2, 1.2)  # s after the start; hands reach objects from then on

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        first, last = (round(seconds * env.robot.control_hz) for seconds in self.BETWEEN)
        self._at = int(rng.integers(first, last, endpoint=True))
        self._angle = rng.uniform(0, 2 * np.pi)
        self._rng = rng
        self._has_shifted = False

    def happened(self) -> bool:
        return self._has_shifted

    def before_step(self, env: Environment, step: int) -> None:
        if step == self._at:
            model, data = simulation(env)
            self._shift(model, data)
            mujoco.mj_forward(model, data)

    def _shift(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        free = objects(model)
        for number in self._rng.permutation(len(free)):
            body, position, dof = free[number]
            if not _at_rest(model, data, body):
                continue
            before = data.qpos[position : position + 2].copy()
            for eighth in range(8):
                angle = self._angle + eighth * np.pi / 4
                data.qpos[position : position + 2] = before + self.level * np.array(
                    [np.cos(angle), np.sin(angle)]
                )
                mujoco.mj_forward(model, data)
                if _at_rest(model, data, body):
                    data.qvel[dof : dof + 6] = 0
                    self._has_shifted = True
                    return
            data.qpos[position : position + 2] = before


def simulation(env: Environment) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's own model and data of an environment that has bodies."""
    bodies = bodies_of(env)
    return _raw(bodies.model), _raw(bodies.data)


def objects(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Of each body with a free joint: its number, its first place in qpos and its first degree of freedom."""
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return [(int(model.jnt_bodyid[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])) for j in joints]


def lowest(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Height of the lowest point of a body's geoms [m], which are boxes, cylinders, capsules or spheres."""
    heights = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        upwards, size = np.abs(data.geom_xmat[geom][6:]), model.geom_size[geom]
        if model.geom_type[geom] == BOX:
            reach = upwards @ size
        elif model.geom_type[geom] == CYLINDER:
            reach = upwards[2] * size[1] + size[0] * np.sqrt(max(0.0, 1 - upwards[2] ** 2))
        elif model.geom_type[geom] == CAPSULE:
            reach = upwards[2] * size[1] + size[0]
        else:
            reach = size[0]
        heights.append(data.geom_xpos[geom][2] - reach)
    return float(min(heights))


def _at_rest(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> bool:
    """Whether nothing but the fixed world touches a body."""
    touching = model.geom_bodyid[data.contact.geom[: data.ncon]]
    others = touching[(touching == body).any(axis=1)]
    return bool((model.body_weldid[others[others != body]] == 0).all())


def _across(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Which of a box's three half sizes lie across the body's x axis: all but the one nearest to it."""
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, model.geom_quat[geom])
    return np.arange(3) != np.abs(turned[:3]).argmax()


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _raw(wrapped: object) -> object:
    """MuJoCo's own object inside dm_control's."""
    return getattr(wrapped, "ptr", wrapped)
