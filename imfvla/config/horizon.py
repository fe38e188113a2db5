"""Horizon: the index arithmetic between observations and predicted chunks; `rollouts.clock` has that of execution."""

from dataclasses import dataclass

import numpy as np

from imfvla.errors import UserError
from imfvla.options import is_whole

MAX_STEPS = 1000  # more than an episode has


@dataclass(frozen=True, slots=True)
class Horizon:
    """How many control steps a policy observes, predicts and executes.

    At the decision step `s` the policy sees the observations of steps `s - obs + 1 ... s` (the first one repeated
    where the episode has not begun yet), predicts the actions of steps `s ... s + pred - 1` and executes those of
    `s ... s + exec - 1`. Action `s` is applied right after observation `s`.

    With `ensemble`, the decay of `imfvla.rollouts.ensemble.TemporalEnsemble`, every step is a decision (exec = 1) and
    the executed action is a mean over all chunks that cover it.

    With `prefix_max`, the policy learns to complete up to so many first actions of a chunk that are decided already.
    """

    obs: int
    pred: int
    exec: int
    ensemble: float | None = None
    prefix_max: int = 0

    def __post_init__(self) -> None:
        for name in ("obs", "pred", "exec"):
            self._check(name, 1, MAX_STEPS)
        self._check("prefix_max", 0, self.pred - 1, ", horizon.pred - 1,")
        if self.exec > self.pred:
            raise UserError(
                f"horizon.exec must not exceed horizon.pred: only predicted actions can be executed, "
                f"found exec={self.exec} and pred={self.pred}; lower horizon.exec or raise horizon.pred."
            )
        if self.ensemble is not None and (self.ensemble < 0 or self.exec != 1):
            raise UserError(
                f"horizon.ensemble averages the chunks of all steps and needs horizon.exec=1 and a decay of at least "
                f"0, found exec={self.exec} and ensemble={self.ensemble}; set horizon.exec=1 or horizon.ensemble=null."
            )

    def _check(self, name: str, least: int, most: int, which: str = ",") -> None:
        value = getattr(self, name)
        if not is_whole(value) or not least <= value <= most:
            raise UserError(
                f"horizon.{name} must be a whole number between {least} and {most}{which} found {value!r}."
            )

    def observed_steps(self, step: int | np.ndarray) -> np.ndarray:
        """Steps seen at a decision, or at several (...,): int64 (..., obs), oldest first, clamped at the start."""
        return np.maximum(np.asarray(step)[..., None] + np.arange(1 - self.obs, 1), 0)

    def action_steps(
        self, step: int | np.ndarray, episode_length: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Steps of the chunks decided at `step`, one or several (...,), each of an episode of that length.

        int64 (..., pred), the last repeated past the episode's end, and bool (..., pred) whether it is before the end.
        """
        steps = np.asarray(step)[..., None] + np.arange(self.pred)
        end = np.asarray(episode_length)[..., None]
        return np.minimum(steps, end - 1), steps < end
