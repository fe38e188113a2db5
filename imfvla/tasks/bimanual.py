"""What our own tasks share: the composer task with its staged reward."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from imfvla.tasks.bimanual_robot import CONTROL_HZ, SIDES
from imfvla.tasks.catalogue import entry_of
from imfvla.tasks.props import Prop
from imfvla.tasks.robot import FINGER_TRAVEL, home_joints
from imfvla.tasks.scene import PHYSICS_TIMESTEP_S, Scene

START_OPENING = 0.8


@dataclass(frozen=True, slots=True)
class StartRange:
    """Where an object may lie at the start: x and y of its centre [m], yaw [rad]; each is drawn uniformly."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float]

    def draw(self, random_state: np.random.RandomState) -> tuple[float, float, float]:
        return tuple(random_state.uniform(*limits) for limits in (self.x, self.y, self.yaw))


@dataclass(frozen=True, slots=True)
class Pose:
    """A frame in the world: position (3,) [m], rotation (3, 3)."""

    position: np.ndarray
    rotation: np.ndarray

    def at(self, offset: np.ndarray) -> np.ndarray:
        """World position (3,) of the point `offset` (3,) of this frame."""
        return self.position + self.rotation @ offset


@dataclass(frozen=True, slots=True)
class _Ids:
    """Indices into the compiled model, looked up once."""

    qpos: np.ndarray  # (16,) of the joints in the order of the robot's channels; a gripper's first finger
    start: np.ndarray  # (18,) of all arm and finger joints, arms in the order of SIDES
    grip: dict[str, int]  # side -> site
    fingers: dict[str, tuple[frozenset[int], ...]]  # side -> geoms of each finger
    body: dict[str, int]  # prop -> body
    free: dict[str, int]  # prop -> first qpos of its free joint
    geoms: dict[str, np.ndarray]  # prop -> bool (num_geoms,)
    table: int


class BimanualTask(composer.Task):
    """Two arms, one table and some props. Subclasses place the props and say which stage holds.

    Attributes for subclasses to set: `name`, an entry of `catalogue.TASKS`, and `ranges` (prop name -> StartRange).
    `goal` is the task whose stages count and whose instruction is given: the task itself, except in a scene that serves
    several tasks.
    """

    name: str
    ranges: dict[str, StartRange]

    def __init__(self, variant: str, props: dict[str, Prop]) -> None:
        self.variant = variant
        self.props = props
        self._scene = Scene()
        for prop in props.values():
            self._scene.add_free_entity(prop)
        self.set_timesteps(control_timestep=1 / CONTROL_HZ, physics_timestep=PHYSICS_TIMESTEP_S)
        state = observable.Generic(self.state)
        state.enabled = True
        self._observables = OrderedDict(state=state)
        self._ids: _Ids | None = None

    @property
    def root_entity(self) -> Scene:
        return self._scene

    @property
    def task_observables(self) -> OrderedDict:
        return self._observables

    @property
    def goal(self) -> str:
        return self.name

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages, in order."""
        return entry_of(self.goal).stages

    @property
    def failed(self) -> bool:
        """Whether something has happened in this episode after which it is no success, whatever its stages."""
        return False

    def begin(self, seed: int) -> np.random.RandomState:
        """What the start state of the episode `seed` is drawn from."""
        return np.random.RandomState(seed)

    def draw_starts(self, random_state: np.random.RandomState) -> dict[str, tuple[float, float, float]]:
        """x, y [m] and yaw [rad] of each prop at the start."""
        return {name: self.ranges[name].draw(random_state) for name in self.props}

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        model = physics.model
        joint = {
            side: [f"{side}/joint_{i}" for i in range(1, 8)] + [f"{side}/finger_a", f"{side}/finger_b"]
            for side in SIDES
        }

        def address(name: str) -> int:
            return int(model.jnt_qposadr[model.name2id(name, "joint")])

        body = {name: model.name2id(f"{name}/", "body") for name in self.props}
        self._ids = _Ids(
            qpos=np.array([address(n) for side in SIDES for n in joint[side][:8]]),
            start=np.array([address(n) for side in SIDES for n in joint[side]]),
            grip={side: model.name2id(f"{side}/grip", "site") for side in SIDES},
            fingers={
                side: tuple(
                    frozenset(model.name2id(f"{side}/finger_{f}_{pad}", "geom") for pad in ("near", "far"))
                    for f in "ab"
                )
                for side in SIDES
            },
            body=body,
            free={name: int(model.jnt_qposadr[model.body_jntadr[i]]) for name, i in body.items()},
            geoms={name: np.asarray(model.geom_bodyid) == i for name, i in body.items()},
            table=model.name2id("table", "geom"),
        )

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        arm = np.concatenate([home_joints(), [START_OPENING * FINGER_TRAVEL] * 2])
        physics.data.qpos[self._ids.start] = np.concatenate([arm, arm])
        physics.data.ctrl[:] = np.tile(np.concatenate([home_joints(), [START_OPENING]]), 2)
        for name, (x, y, yaw) in self.draw_starts(random_state).items():
            at = self._ids.free[name]
            physics.data.qpos[at : at + 7] = (
                *(x, y, self.props[name].rest_height),
                *(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)),
            )

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """Joint targets [rad] and gripper openings [0, 1] in the order of the actuators, which is the robot's."""
        limits = np.asarray(physics.model.actuator_ctrlrange, dtype=np.float32)
        return specs.BoundedArray((len(limits),), np.float32, limits[:, 0], limits[:, 1])

    def get_reward(self, physics: mjcf.Physics) -> float:
        return float(self.stage(physics))

    def state(self, physics: mjcf.Physics) -> np.ndarray:
        """float32 (16,): per arm 7 joint angles [rad] and the measured gripper opening [0, 1]."""
        state = np.asarray(physics.data.qpos[self._ids.qpos], dtype=np.float32)
        state[7::8] = np.clip(state[7::8] / FINGER_TRAVEL, 0, 1)
        return state

    def stage(self, physics: mjcf.Physics) -> int:
        """The highest stage that holds now, 0 for none."""
        raise NotImplementedError

    def grip_pose(self, physics: mjcf.Physics, side: str) -> Pose:
        """Frame between the fingertips of one arm, aligned with the world's at the start posture."""
        site = self._ids.grip[side]
        return Pose(
            np.array(physics.data.site_xpos[site]), np.array(physics.data.site_xmat[site]).reshape(3, 3)
        )

    def prop_pose(self, physics: mjcf.Physics, name: str) -> Pose:
        """Frame of a prop."""
        body = self._ids.body[name]
        return Pose(np.array(physics.data.xpos[body]), np.array(physics.data.xmat[body]).reshape(3, 3))

    def contacts(self, physics: mjcf.Physics) -> np.ndarray:
        """int (num_contacts, 2): pairs of touching geoms."""
        return np.array(physics.data.ptr.contact.geom).reshape(-1, 2)

    def holds(self, contacts: np.ndarray, side: str, name: str) -> bool:
        """Whether both fingers of one arm touch the prop."""
        other = self.partners(contacts, name)
        return all(finger & other for finger in self._ids.fingers[side])

    def touches(self, contacts: np.ndarray, side: str, name: str) -> bool:
        """Whether any finger of one arm touches the prop."""
        other = self.partners(contacts, name)
        return any(finger & other for finger in self._ids.fingers[side])

    def on_table(self, contacts: np.ndarray, name: str) -> bool:
        """Whether the prop touches the table."""
        return self._ids.table in self.partners(contacts, name)

    @property
    def table(self) -> int:
        """Geom of the table."""
        return self._ids.table

    def partners(self, contacts: np.ndarray, name: str) -> set[int]:
        """Geoms that touch the prop."""
        mine = self._ids.geoms[name][contacts]
        return set(contacts[mine[:, ::-1]].tolist())
