"""What both tasks share: the composer task with its staged reward, and the environment around it."""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_control.mujoco import engine
from dm_env import specs

from imfvla.environment import Outcome
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.tasks.bimanual_robot import ALL_VIEWS, CONTROL_HZ, SIDES, TIME_LIMIT_STEPS, bimanual_robot
from imfvla.tasks.catalogue import entry_of, text_for
from imfvla.tasks.props import Prop
from imfvla.tasks.robot import FINGER_TRAVEL, home_joints
from imfvla.tasks.scene import CAMERAS, PHYSICS_TIMESTEP_S, Scene
from imfvla.views import ViewOptions

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


class BimanualEnvironment:
    """An `environment.Environment` of one task, whose cameras are rendered only when someone looks.

    Actions are joint targets [rad] and gripper openings [0, 1] in the order of `robot.action`. The reward is the
    highest stage that holds after the step. An episode in which the last stage held at any step is a success, unless
    its simulation diverges, which ends it.
    """

    time_limit_steps = TIME_LIMIT_STEPS
    all_views = ALL_VIEWS

    def __init__(self, task: BimanualTask, *, image_size: tuple[int, int], views: tuple[str, ...]) -> None:
        seen = build(ViewOptions, {"views": views, "image_size": image_size}, "observation")
        self.robot = bimanual_robot(seen.views, seen.image_size)
        self.views, self.image_size = seen.views, seen.image_size
        self.task = task
        self._cameras: dict[tuple[str, int, int], engine.Camera] = {}
        self._start_digest = ""
        self._num_steps = self._highest = 0
        self._world = composer.Environment(
            task=task,
            time_limit=(TIME_LIMIT_STEPS - 0.1) / CONTROL_HZ,  # a margin for the sum of 3500 time steps
            random_state=0,
            recompile_mjcf_every_episode=False,
            # a simulation that diverges ends the episode early, with a warning
            raise_exception_on_physics_error=False,
            strip_singleton_obs_buffer_dim=True,
        )
        self._world._mjcf_never_compiled = (
            False  # the constructor has compiled it; episodes do not change the model
        )

    @property
    def physics(self) -> mjcf.Physics:
        return self._world.physics

    @property
    def name(self) -> str:
        return self.task.name

    @property
    def variant(self) -> str:
        return self.task.variant

    @property
    def goal(self) -> str | None:
        """The task of the current episode, where the scene serves several."""
        return None if self.task.goal == self.name else self.task.goal

    @property
    def stages(self) -> tuple[str, ...]:
        """Of the current episode's task."""
        return self.task.stages

    @property
    def instruction(self) -> str:
        """The instruction of the current episode."""
        return text_for(self.task.goal)[0]

    @property
    def paraphrases(self) -> tuple[str, ...]:
        return text_for(self.task.goal)[1]

    def reset(self, seed: int) -> None:
        """Starts an episode from the state that `seed` determines."""
        self._world.random_state.set_state(self.task.begin(seed).get_state())
        self._world.reset()
        self._num_steps = self._highest = 0
        start = np.round(np.asarray(self.physics.data.qpos), 9) + 0.0
        self._start_digest = hashlib.sha256(start.tobytes()).hexdigest()[:16]

    def step(self, action: np.ndarray) -> Outcome:
        """Applies one action (A,) for one control step. UserError unless it is so many finite numbers."""
        action = np.asarray(action, dtype=np.float64)
        channels = self.robot.action
        if action.shape != (len(channels),) or not np.isfinite(action).all():
            raise UserError(
                f"An action must be {len(channels)} finite numbers ({', '.join(channels[:2])}, ...), "
                f"found shape {action.shape}: {action}; check the policy or script that chose it."
            )
        timestep = self._world.step(action)
        stage = int(timestep.reward)
        self._num_steps += 1
        self._highest = max(self._highest, stage)
        ended = timestep.last()
        diverged = ended and self._num_steps < TIME_LIMIT_STEPS
        success = self._highest >= len(self.stages) and not (diverged or self.task.failed)
        return Outcome(float(stage), stage, success, ended)

    def state(self) -> np.ndarray:
        """float32 (S,): per arm 7 joint angles [rad] and the measured gripper opening [0, 1]."""
        return self.task.state(self.physics)

    def stage(self) -> int:
        """The highest stage that holds now, 0 for none."""
        return self.task.stage(self.physics)

    def start_digest(self) -> str:
        """16 hex digits that name the start state of this episode."""
        return self._start_digest

    def model_digest(self) -> str:
        """16 hex digits that name the simulated world: equal digests, equal physics and pictures."""
        return hashlib.sha256(self.task.root_entity.mjcf_model.to_xml_string().encode()).hexdigest()[:16]

    def look(self) -> dict[str, np.ndarray]:
        """Pictures uint8 (H, W, 3) of the configured views."""
        return {view: self.render(view, *self.image_size) for view in self.views}

    def render(self, view: str, height: int, width: int) -> np.ndarray:
        """One of `all_views` at any size: uint8 (height, width, 3)."""
        key = (view, height, width)
        if key not in self._cameras:
            bimanual_robot((view,), (height, width))  # refuses a view that there is not
            self._cameras[key] = engine.Camera(self.physics, height, width, CAMERAS[view])
        return self._cameras[key].render().copy()

    def scene(self) -> mjcf.Physics:
        """The simulator's bodies, see `environment.Bodies`."""
        return self.physics

    def renderer(self) -> str:
        from OpenGL import GL  # here, since the platform is chosen when the environment is built

        def ask() -> str:
            return GL.glGetString(GL.GL_RENDERER).decode()

        with self.physics.contexts.gl.make_current() as context:
            return context.call(ask)

    def close(self) -> None:
        self._cameras.clear()
        self._world.close()
