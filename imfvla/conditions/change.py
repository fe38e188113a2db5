"""What a condition may change of an environment, and the environment around it."""

from typing import Any, ClassVar

import numpy as np

from imfvla.environment import Environment, Outcome

STREAM = 7  # of the random numbers of conditions, apart from those of start states and noise
Pictures = dict[str, np.ndarray]  # view -> uint8 (H, W, 3)


class Change:
    """A condition at one severity. Subclasses override what they change; everything else stays as it is.

    LEVELS: how much, by severity.
    """

    LEVELS: ClassVar[tuple[Any, Any, Any]]

    def __init__(self, severity: int) -> None:
        self.level = self.LEVELS[severity - 1]

    def lacking(self, env: Environment) -> str | None:
        """What the environment must have and does not, as in "a simulator's bodies"; None if nothing."""
        return None

    def end(self, env: Environment) -> None:
        """Takes back what `begin` changed, before the environment is reset."""

    def begin(self, env: Environment, rng: np.random.Generator) -> None:
        """Draws the change of an episode and applies it to the start."""

    def pictures(self, pictures: Pictures, rng: np.random.Generator) -> Pictures:
        """What the cameras show; `rng` is of the step."""
        return pictures

    def state(self, state: np.ndarray) -> np.ndarray:
        """What the robot says of itself, float32 (S,)."""
        return state

    def action(self, action: np.ndarray) -> np.ndarray:
        """What the robot does of an action, float32 (A,)."""
        return action

    def before_step(self, env: Environment, step: int) -> None:
        """Happens at the beginning of control step `step`, after the policy has looked."""

    def happened(self) -> bool | None:
        """Of an event, whether it has come in this episode; None for what holds all the time."""
        return None

    def after_step(self, env: Environment, step: int) -> None:
        """Happens at the end of a control step; the next one is `step`."""


class ChangedWorld:
    """An `Environment` under a condition: all of the one inside, save what `change` changes.

    Videos and recordings show the world as it is; pictures in recordings are what the policy saw.
    """

    def __init__(self, env: Environment, change: Change) -> None:
        self._env, self._change = env, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, seed: int) -> None:
        """Starts the episode that `seed` determines, from the same state as without the condition."""
        self._change.end(self._env)
        self._env.reset(seed)
        self._seed, self._step = seed, 0
        self._change.begin(self._env, self._draws())

    def state(self) -> np.ndarray:
        return self._change.state(self._env.state())

    def look(self) -> Pictures:
        return self._change.pictures(self._env.look(), self._draws(self._step))

    def step(self, action: np.ndarray) -> Outcome:
        self._change.before_step(self._env, self._step)
        outcome = self._env.step(self._change.action(action))
        self._step += 1
        self._change.after_step(self._env, self._step)
        return outcome

    @property
    def condition_happened(self) -> bool | None:
        """Whether an event, such as a bump, has come in this episode; None for what holds all the time."""
        return self._change.happened()

    def _draws(self, *step: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self._seed, STREAM, *step]))


def either_way(factor: float, rng: np.random.Generator) -> float:
    """The factor or its inverse."""
    return float(factor ** rng.choice((-1, 1)))
