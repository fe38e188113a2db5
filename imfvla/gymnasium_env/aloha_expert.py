"""A scripted demonstrator for gym-aloha's tasks, made as ACT's authors make theirs (arXiv 2304.13705, section V).

The hands follow waypoints in gym-aloha's end-effector environment, whose physics pulls them along; the joints that this
gives, with the commanded openings, are the actions in the joint environment. Whether they succeed there is up to it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from imfvla.episode import Decision
from imfvla.errors import UserError
from imfvla.gymnasium_env.aloha_motion import SIDES, Style, Track, insertion_tracks, transfer_tracks
from imfvla.gymnasium_env.environment import GymnasiumEnvironment
from imfvla.options import build, within

STYLE_STREAM, NOISE_STREAM = 31, 32  # of the random numbers of an episode
NOISE_CORRELATION = 0.95  # from step to step
WHILE_HOLDING = 0.25  # share of the noise
NUM_ROBOT_QPOS = 16  # joints and fingers of both arms; objects come after them
OPENINGS = (6, 13)  # of the actions
# gym-aloha's own pull on the hands lags behind by centimetres; this one, by millimetres.
STIFFNESS = (0.9, 0.95, 0.001)


@dataclass(frozen=True, slots=True)
class AlohaExpertOptions:
    """`task.expert` of gym-aloha's tasks."""

    spread: Annotated[float, within(0, 2)]
    noise: Annotated[float, within(0, 0.1)]


@dataclass(frozen=True, slots=True)
class _Scene:
    model: str  # file of gym-aloha's end-effector model
    task: str  # class of gym_aloha.tasks.sim_end_effector
    tracks: Callable[[np.ndarray, Style], Mapping[str, Track]]


SCENES = {
    "gym_aloha/AlohaTransferCube-v0": _Scene(
        "bimanual_viperx_end_effector_transfer_cube.xml", "TransferCubeEndEffectorTask", transfer_tracks
    ),
    "gym_aloha/AlohaInsertion-v0": _Scene(
        "bimanual_viperx_end_effector_insertion.xml", "InsertionEndEffectorTask", insertion_tracks
    ),
}


class AlohaExpert:
    """An `episode.Actor` that plays a plan made at the start.

    style: what it drew for this episode, for the recording. Executed actions carry smooth noise in the joints; the
    action to learn is the plan's, so that the data has recoveries.
    """

    style: Mapping[str, float]

    def __init__(self, env_id: str, options: Mapping[str, Any]) -> None:
        if env_id not in SCENES:
            raise UserError(f"There is no expert for {env_id}; there is one for {', '.join(SCENES)}.")
        self._scene = SCENES[env_id]
        self._options = build(AlohaExpertOptions, options, "task.expert")
        self._planner = _Planner(self._scene)

    def reset(self, env: GymnasiumEnvironment, seed: int) -> None:
        """Measures where the objects are and plans the whole episode."""
        rng = np.random.default_rng(np.random.SeedSequence([seed, STYLE_STREAM]))
        style = Style.draw(rng, self._options.spread)
        self.style = style.to_json()
        objects = env.cameras.start()[NUM_ROBOT_QPOS:]
        self._plan = self._planner.plan(objects, self._scene.tracks(objects, style), env.time_limit_steps)
        self._low, self._high = np.float32(env.robot.action_min), np.float32(env.robot.action_max)
        self._noise_rng = np.random.default_rng(np.random.SeedSequence([seed, NOISE_STREAM]))
        self._disturbance = np.zeros(self._plan.shape[1])
        self._step = 0

    def act(self, env: GymnasiumEnvironment, state: np.ndarray, step: int) -> Decision:
        """The plan's action of `step`, and the same with noise to execute."""
        clean = self._plan[step]
        fresh = self._noise_rng.standard_normal(len(clean))
        self._disturbance = NOISE_CORRELATION * self._disturbance + np.sqrt(1 - NOISE_CORRELATION**2) * fresh
        noise = self._options.noise * _freedom(clean) * self._disturbance
        self._step = step + 1
        executed = np.clip(clean + noise, self._low, self._high).astype(np.float32)
        return Decision(action=np.clip(clean, self._low, self._high), executed=executed)

    def done(self, env: GymnasiumEnvironment) -> bool:
        """Whether the plan is played to its end."""
        return self._step >= len(self._plan)


def _freedom(action: np.ndarray) -> np.ndarray:
    """The share of the noise (A,) that an action bears: all of an open hand, little of a closed one, no finger."""
    arms = np.split(action, 2)
    share = [np.full(len(arm), WHILE_HOLDING + (1 - WHILE_HOLDING) * np.clip(arm[-1], 0, 1)) for arm in arms]
    freedom = np.concatenate(share)
    freedom[list(OPENINGS)] = 0
    return freedom


class _Planner:
    """gym-aloha's end-effector environment without pictures."""

    def __init__(self, scene: _Scene) -> None:
        # Here, since gym-aloha is an extra and its import chooses how MuJoCo draws.
        from dm_control import mujoco
        from dm_control.rl import control
        from gym_aloha import constants
        from gym_aloha.tasks import sim_end_effector

        task_class = getattr(sim_end_effector, scene.task)

        class Task(task_class):
            objects: np.ndarray

            def initialize_episode(self, physics: Any) -> None:
                self.initialize_robots(physics)
                physics.data.qpos[NUM_ROBOT_QPOS:] = self.objects

            def get_observation(self, physics: Any) -> dict[str, Any]:
                return {}

        self._task = Task()
        physics = mujoco.Physics.from_xml_path(str(constants.ASSETS_DIR / scene.model))
        physics.model.eq_solimp[:, :3] = STIFFNESS
        self._env = control.Environment(
            physics, self._task, float("inf"), control_timestep=constants.DT, flat_observation=False
        )
        self._opening = constants.normalize_puppet_gripper_position

    def plan(self, objects: np.ndarray, tracks: Mapping[str, Track], most: int) -> np.ndarray:
        """Joint targets float32 (T, A) that lead the hands along `tracks`, at most `most` of them."""
        self._task.objects = objects
        self._env.reset()
        physics, targets = self._env.physics, []
        num_steps = min(most, int(np.ceil(max(track.end for track in tracks.values()))))
        for step in range(num_steps):
            self._env.step(np.concatenate([tracks[side].at(step) for side in SIDES]))
            target = self._task.get_qpos(physics)
            target[list(OPENINGS)] = [self._opening(physics.data.ctrl[finger]) for finger in (0, 2)]
            targets.append(target)
        return np.array(targets, np.float32)
