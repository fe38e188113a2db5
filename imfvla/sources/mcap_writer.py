"""Episodes of any robot as recordings of this project, one MCAP file each, which open in Foxglove."""

import hashlib
from pathlib import Path
from types import SimpleNamespace, TracebackType

import numpy as np

from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.recording import McapSink
from imfvla.robot import RobotSpec
from imfvla.sources.base import EpisodeArrays
from imfvla.sources.new_folder import NewFolder

NO_WORLD = SimpleNamespace()  # in place of an environment: there is nothing to render and no body to show


class McapWriter:
    """Writes episodes into a new folder: `with McapWriter(path, robot) as writer: writer.add(episode)`.

    After an error nothing is left. What a data set does not have is recorded as none: reward 0, no success. Raises
    UserError where something is at `path`, or nothing can be written.
    """

    def __init__(self, path: str | Path, robot: RobotSpec) -> None:
        self.path, self._robot = Path(path), robot
        self._folder = NewFolder(self.path, self._check, lambda: None)
        self._num_episodes = 0

    def __enter__(self) -> "McapWriter":
        self._part = self._folder.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.__exit__(kind, error, trace)

    def add(self, episode: EpisodeArrays) -> None:
        """Writes an episode to episode-000000.mcap, the next one to episode-000001.mcap, and so on."""
        number, robot = self._num_episodes, self._robot
        start = hashlib.sha256(np.ascontiguousarray(episode.state[0]).tobytes()).hexdigest()[:16]
        instruction, *paraphrases = episode.instructions
        info = EpisodeInfo(
            task=episode.task,
            kind="demonstration",
            seed=number,
            start_digest=start,
            instruction=instruction,
            views=tuple(episode.images),
            robot=robot,
            config={},
            metadata={"converted_from": episode.name, "paraphrases": paraphrases},
        )
        taken = {int(step): place for place, step in enumerate(episode.image_steps)}
        sink = McapSink(self._part / f"episode-{number:06d}.mcap")
        try:
            sink.begin(NO_WORLD, info)
            for index, (state, action) in enumerate(zip(episode.state, episode.action, strict=True)):
                images = {}
                if index in taken:
                    images = {view: frames[taken[index]] for view, frames in episode.images.items()}
                imitate = None if episode.imitate is None else bool(episode.imitate[index])
                decision = Decision(action, action, images, imitate=imitate)
                sink.step(NO_WORLD, Step(index, index / robot.control_hz, state, decision, 0.0, 0))
            sink.end(
                EpisodeResult(
                    seed=number,
                    start_digest=start,
                    num_steps=len(episode.state),
                    total_reward=0.0,
                    max_reward=0.0,
                    success=False,
                    first_step_of_stage=(),
                    failure=None,
                    inference_ms=(),
                    wall_s=0.0,
                )
            )
        except BaseException:
            sink.abort()
            raise
        self._num_episodes += 1

    def _check(self) -> None:
        if self._num_episodes == 0:
            raise UserError(f"{self.path}: wanted at least one episode, found none; nothing was written.")
