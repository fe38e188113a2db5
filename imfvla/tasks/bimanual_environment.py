"""The environment around one of our own tasks."""

import hashlib

import numpy as np
from dm_control import composer, mjcf
from dm_control.mujoco import engine

from imfvla.config.views import ViewOptions
from imfvla.environment import Outcome
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.tasks.bimanual import BimanualTask
from imfvla.tasks.bimanual_robot import ALL_VIEWS, CONTROL_HZ, TIME_LIMIT_STEPS, bimanual_robot
from imfvla.tasks.catalogue import text_for
from imfvla.tasks.distractors import Shape, add_to_scene, draw_shapes
from imfvla.tasks.scene import CAMERAS


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
        self._distractors: tuple[Shape, ...] = ()
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
        self._distractors = ()
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
            self._cameras[key] = engine.Camera(
                self.physics,
                height,
                width,
                CAMERAS[view],
                scene_callback=lambda _, scene: add_to_scene(self._distractors, scene),
            )
        return self._cameras[key].render().copy()

    def distract(self, count: int, rng: np.random.Generator) -> None:
        """Shows so many objects on the table that nothing can touch, until the next reset."""
        lying = [self.task.prop_pose(self.physics, name).position[:2] for name in self.task.props]
        self._distractors = draw_shapes(count, rng, lying)

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
