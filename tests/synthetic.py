"""Small recorded demonstrations without a simulator: what one sees determines what one does."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.recording import McapSink
from imfvla.robot import RobotSpec
from imfvla.tasks.bimanual_robot import bimanual_robot

VIEWS = ("front", "top", "r_wrist")
INSTRUCTION = "put the peg into the socket"
ROBOT = bimanual_robot(VIEWS, (32, 32))
PARAPHRASES = ("insert the peg", "push the peg into the hole")


class StillScene:
    """Takes the place of an environment: a red box, and frames where a square moves with `position`."""

    def __init__(self, robot: RobotSpec) -> None:
        self.robot, self.position = robot, 0.0
        self.views = tuple(camera.name for camera in robot.cameras)
        model = SimpleNamespace(
            names=b"synthetic\0world\0box\0",
            name_bodyadr=np.array([10, 16]),
            ngeom=1,
            geom_group=np.zeros(1, int),
            geom_bodyid=np.ones(1, int),
            geom_matid=np.full(1, -1),
            geom_rgba=np.array([[1.0, 0.0, 0.0, 1.0]]),
            geom_type=np.full(1, 6),
            geom_size=np.full((1, 3), 0.1),
            geom_pos=np.zeros((1, 3)),
            geom_quat=np.array([[1.0, 0.0, 0.0, 0.0]]),
        )
        data = SimpleNamespace(xpos=np.zeros((2, 3)), xquat=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
        self._bodies = SimpleNamespace(model=model, data=data)

    def scene(self) -> SimpleNamespace:
        return self._bodies

    def look(self) -> dict[str, np.ndarray]:
        frames = {}
        for number, view in enumerate(self.views):
            camera = self.robot.camera(view)
            height, width = camera.height, camera.width
            column = int((self.position + 1) / 2 * (width - width // 4))
            frame = np.full((height, width, 3), 40 * number, np.uint8)
            frame[height // 3 : 2 * height // 3, column : column + width // 4] = (200, 220, 240 - number)
            frames[view] = frame
        return frames


def synthetic_actions(seed: int, num_steps: int, robot: RobotSpec = ROBOT) -> np.ndarray:
    """float32 (num_steps, A): the actions of the episode of this seed, no two rows of any episode equal.

    Those that are no displacements lie in [0, 1], as grippers do.
    """
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(robot.action))
    steps = np.arange(num_steps)[:, None]
    actions = np.sin(phase + 0.1 * steps)
    actions[:, ~robot.relative] = actions[:, ~robot.relative] / 2 + 0.5
    return actions.astype(np.float32)


def write_episode(
    path: Path,
    seed: int,
    *,
    num_steps: int = 24,
    views: tuple[str, ...] = VIEWS,
    image_size: tuple[int, int] = (32, 32),
    camera_every: int = 2,
    task: str = "socket",
) -> None:
    """Records one episode whose state at step s is the action of step s - 1, seen in the frames of step s."""
    robot = bimanual_robot(views, image_size)
    env = StillScene(robot)
    actions = synthetic_actions(seed, num_steps, robot)
    states = np.concatenate([actions[:1], actions[:-1]])
    info = EpisodeInfo(
        task=task,
        kind="demonstration",
        seed=seed,
        start_digest=f"{seed:016x}",
        instruction=INSTRUCTION,
        views=views,
        robot=robot,
        config={"name": "synthetic"},
        metadata={"paraphrases": PARAPHRASES},
    )
    sink = McapSink(path, render_every=camera_every)
    env.position = states[0, 0]
    sink.begin(env, info)
    for index in range(num_steps):
        env.position = actions[index, 0]  # what the action brings about, and the frames of the next step show
        noise = np.float32(0.01 * (-1) ** index)
        decision = Decision(actions[index], actions[index] + noise)
        sink.step(env, Step(index, index / robot.control_hz, states[index], decision, 0.0, 0))
    sink.end(
        EpisodeResult(
            seed=seed,
            start_digest=f"{seed:016x}",
            num_steps=num_steps,
            total_reward=0.0,
            max_reward=0.0,
            success=False,
            first_step_of_stage=(-1,) * 5,
            failure=None,
            inference_ms=(),
            wall_s=0.0,
        )
    )


def write_demonstrations(directory: Path, *, num_episodes: int = 3, **episode) -> Path:
    """Records episodes of seeds 0, 1, ... as `episode-00000.mcap`, ...; `episode` as for `write_episode`."""
    for seed in range(num_episodes):
        write_episode(directory / f"episode-{seed:05d}.mcap", seed, **episode)
    return directory
