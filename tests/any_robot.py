"""Robots of any shape, and episodes of them in memory: what one sees and feels determines what one does."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from imfvla.robot import Camera, RobotSpec
from imfvla.sources.base import EpisodeArrays

SIZES = ((24, 32), (16, 16), (20, 40), (32, 24))  # (H, W) [px] of up to four cameras
SENTENCE = "move the block"


def robot_of_size(
    num_actions: int, num_states: int, *, num_cameras: int = 1, control_hz: float = 10.0
) -> RobotSpec:
    """A robot whose action i displaces state i + 1, except for every seventh, which is a gripper's opening."""
    grippers = [index % 7 == 6 for index in range(num_actions)]
    return RobotSpec(
        state=tuple(f"part_{index}/position [rad]" for index in range(num_states)),
        action=tuple(
            f"part_{index}/gripper [0, 1]" if gripper else f"part_{index}/target [rad]"
            for index, gripper in enumerate(grippers)
        ),
        relative_to=tuple(
            None if gripper else (index + 1) % num_states for index, gripper in enumerate(grippers)
        ),
        action_min=tuple(0.0 if gripper else -4.0 for gripper in grippers),
        action_max=tuple(1.0 if gripper else 4.0 for gripper in grippers),
        control_hz=control_hz,
        cameras=tuple(Camera(f"camera_{number}", *size) for number, size in enumerate(SIZES[:num_cameras])),
    )


class MemorySource:
    """An `EpisodeSource` of drawn episodes, whose cameras look at every second step."""

    def __init__(self, robot: RobotSpec, num_episodes: int = 4, num_steps: int = 20) -> None:
        self.robot = robot
        self.episodes = [self._draw(number, num_steps) for number in range(num_episodes)]

    def __len__(self) -> int:
        return len(self.episodes)

    def episode(self, index: int, views: Collection[str] = ()) -> EpisodeArrays:
        episode = self.episodes[index]
        return replace(
            episode, images={view: episode.images[view] for view in views if view in episode.images}
        )

    def num_frames(self, index: int) -> int:
        return len(self.episodes[index].image_steps)

    def digest(self) -> str:
        return f"{len(self.episodes):064x}"

    def _draw(self, number: int, num_steps: int) -> EpisodeArrays:
        rng = np.random.default_rng(number)
        state = np.cumsum(0.05 * rng.normal(size=(num_steps, len(self.robot.state))), axis=0)
        action = state[:, self.robot.origin] + 0.1 * rng.normal(size=(num_steps, len(self.robot.action)))
        action[:, ~self.robot.relative] = rng.uniform(size=(num_steps, np.sum(~self.robot.relative)))
        steps = np.arange(0, num_steps, 2)
        return EpisodeArrays(
            name=f"episode {number}",
            task="block",
            instructions=(SENTENCE,),
            state=state.astype(np.float32),
            action=action.astype(np.float32),
            image_steps=steps,
            images={
                camera.name: rng.integers(
                    256, size=(len(steps), camera.height, camera.width, 3), dtype=np.uint8
                )
                for camera in self.robot.cameras
            },
        )


def names_of(cameras: Sequence[Camera]) -> list[str]:
    return [camera.name for camera in cameras]
