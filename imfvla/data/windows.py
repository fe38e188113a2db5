"""Training items: what was observed at a decision and the actions that followed.

Shapes: B batch, W windows, To observed steps, Tp predicted steps, V views, L instruction words.
"""

from collections.abc import Collection

import numpy as np
import torch

from imfvla.data.frame_store import FrameStore
from imfvla.errors import UserError
from imfvla.horizon import Horizon
from imfvla.instruction import tokenize
from imfvla.robot import RobotSpec
from imfvla.statistics import Statistics
from imfvla.types import Batch, Observation


class Windows:
    """All decisions of a store that a policy of this horizon could have faced.

    A step is a decision if every step that `Horizon.observed_steps` names for it has frames. With `obs=1`
    these are all steps with frames. With `obs>=2` a rollout sees consecutive control steps, so the
    episodes must have frames at every step (`camera_every=1`), or where a policy of the same horizon
    saw them; episodes with gaps would leave only the first step of each episode and are refused with a
    UserError.

    With `paraphrases` an item's sentence is drawn from the recorded one and its paraphrases, otherwise it is the
    recorded one. `episodes` are those of the store that count, by number; None for all.
    """

    def __init__(
        self,
        store: FrameStore,
        horizon: Horizon,
        robot: RobotSpec,
        *,
        paraphrases: bool = True,
        episodes: Collection[int] | None = None,
    ) -> None:
        self.store = store
        self.chosen = range(len(store.episodes)) if episodes is None else sorted(episodes)
        self.horizon = horizon
        self.robot = robot
        self._index_windows()
        self._index_instructions(paraphrases)

    def __len__(self) -> int:
        return len(self.steps)

    def batch(self, indices: np.ndarray, rng: np.random.Generator) -> Batch:
        """The windows `indices` (B,), each with one of its episode's sentences drawn by `rng`."""
        frames = self._frames[indices]
        images = np.take(self.store.images, frames.reshape(-1), axis=0)
        episodes = self.episodes[indices]
        sentences = self._first_sentence[episodes] + rng.integers(self._num_sentences[episodes])
        observation = Observation(
            images=torch.from_numpy(images.reshape(*frames.shape, *images.shape[1:])),
            state=torch.from_numpy(self.store.state[self._observed[indices]]),
            instruction=torch.from_numpy(self._word_ids[sentences]),
        )
        actions = torch.from_numpy(self.store.action[self._followed[indices]])
        return Batch(observation, actions, torch.from_numpy(self._valid[indices]))

    def decided(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Without pictures: states (B, S) at the decisions `indices`, actions (B, Tp, A) and valid (B, Tp)."""
        state = self.store.state[self._observed[indices, -1]]
        return state, self.store.action[self._followed[indices]], self._valid[indices]

    def describe(self, indices: np.ndarray) -> list[str]:
        """Episode and decision step of each window."""
        names = [self.store.episodes[number].name for number in self.episodes[indices]]
        return [f"{name}, step {step}" for name, step in zip(names, self.steps[indices], strict=True)]

    def statistics(self) -> Statistics:
        """Of states and actions over all control steps, with frames or without; of displacements over all windows."""
        store, rows = self.store, self._rows()
        decided_at = store.state[self._observed[:, -1:]]
        displacement = store.action[self._followed] - decided_at[..., self.robot.origin]
        return Statistics.of(store.state[rows], store.action[rows], displacement, self._valid)

    def _rows(self) -> np.ndarray | slice:
        """The rows of the store's states and actions that belong to the chosen episodes."""
        if len(self.chosen) == len(self.store.episodes):
            return slice(None)
        chosen = [self.store.episodes[number] for number in self.chosen]
        return np.concatenate([np.arange(one.num_steps) + one.first_row for one in chosen])

    def _index_windows(self) -> None:
        episodes, steps, frames, observed, followed, valid = [], [], [], [], [], []
        for number in self.chosen:
            episode = self.store.episodes[number]
            frame_at = np.full(episode.num_steps, -1)
            frame_at[episode.image_steps] = episode.first_frame + np.arange(len(episode.image_steps))
            for step in episode.image_steps:
                seen = self.horizon.observed_steps(step)
                if (frame_at[seen] < 0).any():
                    continue
                after, after_valid = self.horizon.action_steps(step, episode.num_steps)
                episodes.append(number)
                steps.append(step)
                frames.append(frame_at[seen])
                observed.append(episode.first_row + seen)
                followed.append(episode.first_row + after)
                valid.append(after_valid)
        if not steps or (self.horizon.obs > 1 and not any(steps)):
            raise UserError(
                f"horizon.obs={self.horizon.obs} needs frames at that many consecutive control steps, and "
                f"the episodes in {self.store.path} have none: collect with camera_every=1, or set "
                "horizon.obs=1."
            )
        self.episodes = np.array(episodes)  # (W,)  number of the episode in the store
        self.steps = np.array(steps)  # (W,)  decision step within the episode
        self._frames = np.array(frames)  # (W, To)  rows of store.images
        self._observed = np.array(observed)  # (W, To)  rows of store.state
        self._followed = np.array(followed)  # (W, Tp)  rows of store.action
        self._valid = np.array(valid)  # (W, Tp)

    def _index_instructions(self, paraphrases: bool) -> None:
        sentences: list[str] = []
        first, count = [], []
        for episode in self.store.episodes:
            known = dict.fromkeys(episode.instructions if paraphrases else episode.instructions[:1])
            first.append(len(sentences))
            count.append(len(known))
            sentences.extend(known)
        self._word_ids = np.stack([tokenize(sentence) for sentence in sentences])  # (sentences, L)
        self._first_sentence, self._num_sentences = np.array(first), np.array(count)  # (episodes,)
