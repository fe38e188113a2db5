"""Training items: what was observed at a decision and the actions that followed.

Shapes: B batch, W windows, To observed steps, Tp predicted steps, V views, S state, A action, L instruction words.
"""

from collections.abc import Collection

import numpy as np
import torch

from imfvla.config.horizon import Horizon
from imfvla.data.frame_store import FrameStore
from imfvla.data.statistics import RunningStatistics, Statistics
from imfvla.errors import UserError
from imfvla.robot import RobotSpec
from imfvla.types import Batch, Observation, tokenize


class Windows:
    """All decisions of a store that a policy of this horizon could have faced.

    A step is a decision if every step that `Horizon.observed_steps` names for it has frames. With `obs=1`
    these are all steps with frames. With `obs>=2` a rollout sees consecutive control steps, so the
    episodes must have frames at every step (`camera_every=1`), or where a policy of the same horizon
    saw them; episodes with gaps would leave only the first step of each episode and are refused with a
    UserError.

    A step that is not to be imitated is no decision, and a chunk that reaches such a step ends before it, as it ends
    with its episode.

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
        return len(self._frame)

    def decisions(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The windows `indices` (B,): numbers of their episodes in the store, steps decided at within these (B,)."""
        frame = self._frame[indices]
        return self._episode_of(frame), self.store.image_steps[frame]

    def batch(self, indices: np.ndarray, rng: np.random.Generator) -> Batch:
        """The windows `indices` (B,), each with one of its episode's sentences drawn by `rng`."""
        frame = self._frame[indices]
        episodes, steps = self._episode_of(frame), self.store.image_steps[frame]
        seen = self.horizon.observed_steps(steps)
        # All of these steps have frames, so that as many frames lie between two of them as steps.
        frames = (frame - steps)[:, None] + seen
        images = np.take(self.store.images, frames.reshape(-1), axis=0)
        sentences = self._first_sentence[episodes] + rng.integers(self._num_sentences[episodes])
        observation = Observation(
            images=torch.from_numpy(images.reshape(*frames.shape, *images.shape[1:])),
            state=torch.from_numpy(self.store.state[self._first_row[episodes, None] + seen]),
            instruction=torch.from_numpy(self._word_ids[sentences]),
        )
        actions, valid = self._followed(episodes, steps)
        return Batch(observation, torch.from_numpy(actions), torch.from_numpy(valid))

    def decided(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Without pictures: states (B, S) at the decisions `indices`, actions (B, Tp, A) and valid (B, Tp)."""
        episodes, steps = self.decisions(indices)
        return self.store.state[self._first_row[episodes] + steps], *self._followed(episodes, steps)

    def describe(self, indices: np.ndarray) -> list[str]:
        """Episode and decision step of each window."""
        return [
            f"{self.store.episodes[number].name}, step {step}"
            for number, step in zip(*self.decisions(indices), strict=True)
        ]

    def statistics(self) -> Statistics:
        """Of states and actions over all control steps to be imitated, with frames or without.

        Of displacements over all windows.
        """
        store, running = self.store, RunningStatistics(self.robot.origin, self.horizon.pred)
        firsts = np.searchsorted(self._frame, self._first_frame[self.chosen])
        ends = np.append(firsts[1:], len(self._frame))
        for number, first, end in zip(self.chosen, firsts, ends, strict=True):
            episode = store.episodes[number]
            decisions = store.image_steps[self._frame[first:end]]
            for begin, stop in episode.learned:
                rows = slice(episode.first_row + begin, episode.first_row + stop)
                inside = decisions[(begin <= decisions) & (decisions < stop)] - begin
                running.add(store.state[rows], store.action[rows], inside)
        return running.result()

    def _followed(self, episodes: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Actions (B, Tp, A) and valid (B, Tp) of the chunks decided at these steps of these episodes (B,)."""
        row = self._first_row[episodes] + steps
        end = self._ends[np.searchsorted(self._ends, row, side="right")] - self._first_row[episodes]
        after, valid = self.horizon.action_steps(steps, end)
        return self.store.action[self._first_row[episodes, None] + after], valid

    def _episode_of(self, frame: np.ndarray) -> np.ndarray:
        """Numbers of the episodes of these frames; one without frames begins where the next one does."""
        return np.searchsorted(self._first_frame, frame, side="right") - 1

    def _index_windows(self) -> None:
        """Holds one number a window, the rest is computed by batch: there may be millions."""
        episodes = self.store.episodes
        self._first_frame = np.array([one.first_frame for one in episodes])  # (episodes,)
        self._first_row = np.array([one.first_row for one in episodes])  # (episodes,)
        # rows at which steps to be imitated end: those of an episode, or what comes before some that are not
        self._ends = np.array([one.first_row + end for one in episodes for _, end in one.learned])
        found = [self._decidable(number) for number in self.chosen]
        self._frame = np.concatenate([np.empty(0, np.int64), *found])  # (W,)  rows of store.images
        if not len(self._frame) or (self.horizon.obs > 1 and not self.store.image_steps[self._frame].any()):
            raise UserError(
                f"horizon.obs={self.horizon.obs} needs frames at that many consecutive control steps, and "
                f"the episodes in {self.store.path} have none: set demos.camera_every=1, or "
                "horizon.obs=1."
            )

    def _decidable(self, number: int) -> np.ndarray:
        """Rows of the store's images at which a policy can decide in an episode: int64, ascending."""
        episode = self.store.episodes[number]
        own = np.arange(len(episode.image_steps))
        seen = self.horizon.observed_steps(episode.image_steps)
        places = own[:, None] + seen - episode.image_steps[:, None]  # of their frames, if none is missing
        has_all = (places >= 0) & (episode.image_steps[np.maximum(places, 0)] == seen)
        decided = has_all.all(axis=1)
        for first, end in episode.skipped:
            decided &= (episode.image_steps < first) | (end <= episode.image_steps)
        return episode.first_frame + own[decided]

    def _index_instructions(self, paraphrases: bool) -> None:
        sentences: list[str] = []
        places: dict[tuple[str, ...], int] = {}  # thousands of episodes share their sentences
        first, count = [], []
        for episode in self.store.episodes:
            known = tuple(dict.fromkeys(episode.instructions if paraphrases else episode.instructions[:1]))
            if known not in places:
                places[known] = len(sentences)
                sentences.extend(known)
            first.append(places[known])
            count.append(len(known))
        self._word_ids = np.stack([tokenize(sentence) for sentence in sentences])  # (sentences, L)
        self._first_sentence, self._num_sentences = np.array(first), np.array(count)  # (episodes,)
