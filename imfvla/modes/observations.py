"""From recorded demonstrations to the observations at which samples are drawn, and what was done there.

Shapes: N observations, To observed steps, V views, H W pixels, S state, L words, Tp predicted steps, A action.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from imfvla.config.horizon import Horizon
from imfvla.modes.grippers import Event, event_of
from imfvla.recording import Episode
from imfvla.types import tokenize


class Place(NamedTuple):
    """A decision step of a demonstration."""

    seed: int
    step: int


@dataclass
class Observations:
    """What was seen at N places, and the actions that followed."""

    places: list[Place] = field(default_factory=list)
    images: list[np.ndarray] = field(default_factory=list)  # uint8 (To, V, H, W, 3)
    state: list[np.ndarray] = field(default_factory=list)  # float32 (To, S)
    instruction: list[np.ndarray] = field(default_factory=list)  # int64 (L,)
    actions: list[np.ndarray] = field(default_factory=list)  # float32 (Tp, A)

    def __len__(self) -> int:
        return len(self.places)

    def add(self, episode: Episode, horizon: Horizon, views: Sequence[str], step: int) -> None:
        seen = horizon.observed_steps(step)
        frames = np.searchsorted(episode.image_steps, seen)
        followed, _ = horizon.action_steps(step, len(episode.action))
        self.places.append(Place(episode.info.seed, step))
        self.images.append(np.stack([episode.images[view][frames] for view in views], axis=1))
        self.state.append(episode.state[seen])
        self.instruction.append(tokenize(episode.info.instruction))
        self.actions.append(episode.action[followed])

    def thin(self, most: int) -> np.ndarray:
        """Keeps at most so many, chosen by chance but always the same ones; returns which."""
        kept = np.sort(np.random.default_rng(0).permutation(len(self))[:most])
        for name in ("places", "images", "state", "instruction", "actions"):
            values = getattr(self, name)
            setattr(self, name, [values[index] for index in kept])
        return kept


class Stops:
    """The places of demonstrations at which samples are judged, at most `most` of each kind.

    `starts`: where an episode begins. `before` and `after`: a decision and the next one, `gap` steps later: the
    executed steps, or as many more as it takes to one with frames.
    `waiting`: before a gripper closes, while nothing observed says when, or else from where a chunk reaches the
    closing; `events` are the closings that these precede.
    """

    def __init__(
        self, horizon: Horizon, views: Sequence[str], grippers: Sequence[int], num_episodes: int, most: int
    ) -> None:
        self._horizon, self._views, self._grippers, self._most = horizon, views, grippers, most
        self._pairs_each = -(-most // (2 * num_episodes))
        self.starts, self.before, self.after, self.waiting = (Observations() for _ in range(4))
        self.events: list[Event] = []
        self.gap = horizon.exec

    def add(self, episode: Episode) -> None:
        usable = self._with_frames(episode)
        self._add(self.starts, episode, usable[:1])
        self.gap = next(
            (step - usable[0] for step in usable if step - usable[0] >= self._horizon.exec), self.gap
        )
        last = len(episode.action) - self._horizon.pred
        pairs = [step for step in usable if step + self.gap in usable and step + self.gap <= last]
        # By chance, since evenly from the first one on would weigh the starts, which are unlike the rest.
        pairs = sorted(
            np.random.default_rng(episode.info.seed).permutation(pairs)[: self._pairs_each].tolist()
        )
        self._add(self.before, episode, pairs)
        self._add(self.after, episode, [step + self.gap for step in pairs])
        event = event_of(episode.action, self._grippers)
        if event is not None:
            wait = episode.info.metadata.get("style", {}).get("wait") or self._horizon.pred
            steps = [step for step in usable if event.step - wait <= step < event.step]
            self._add(self.waiting, episode, steps)
            self.events += [event] * len(steps)

    def finish(self) -> None:
        """To be called after the last episode."""
        kept = self.waiting.thin(self._most)
        self.events = [self.events[index] for index in kept]
        for pairs in (self.before, self.after):
            pairs.thin(max(self._most // 2, 1))

    def _with_frames(self, episode: Episode) -> list[int]:
        with_frames = set(episode.image_steps.tolist())
        return [
            step
            for step in sorted(with_frames)
            if with_frames.issuperset(self._horizon.observed_steps(step).tolist())
        ]

    def _add(self, observations: Observations, episode: Episode, steps: Sequence[int]) -> None:
        for step in steps:
            observations.add(episode, self._horizon, self._views, step)
