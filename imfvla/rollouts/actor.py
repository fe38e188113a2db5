"""ChunkActor: a policy that looks, predicts a chunk of actions, executes its first entries and looks again.

Shapes: To observed steps, V views, H W pixels, S state, Tp predicted steps, A action.
"""

import time
from collections.abc import Sequence

import numpy as np
import torch

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, FRESH, GUIDED, NO_PREFIX, USUAL_NOISE
from imfvla.environment import Environment
from imfvla.environments.rollout import FAR_OUT_OF_RANGE, NON_FINITE
from imfvla.episode import ActionError, Decision
from imfvla.generators.inpainting import soft_weights
from imfvla.policy import Policy
from imfvla.policy.prefix import Known
from imfvla.rollouts.clock import Clock
from imfvla.rollouts.ensemble import TemporalEnsemble
from imfvla.rollouts.inference import Question, answers, observation_of
from imfvla.rollouts.noise import ReplanningNoise, distances
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.types import tokenize

# A sound policy exceeds the limits slightly and is clipped; one that exceeds them by this many range
# widths has diverged, and clipping would only hide it.
FAR = 10.0


class ChunkActor:
    """Plays a policy in closed loop: an `episode.Actor` that looks and replans when its clock says so.

    Without a clock, the world waits for every chunk, and the policy replans every `horizon.exec` control steps.
    Cameras are rendered only at the steps that enter a decision. The noise of replanning k in the
    episode `seed` is drawn from `SeedSequence([noise_seed, seed, k])` alone, so all policies with chunks of
    the same shape see the same noise. It is multiplied by `noise_scale`; `noise` says what becomes of it from one
    replanning to the next (`rollouts.noise`). Of several `candidates`, sampled as one batch from one encoding, the one
    is taken that is nearest to the last chunk over the steps that both cover (backward coherence of arXiv 2408.17355).
    With `tells_jumps`, decisions say how far that is, root-mean-square in shares of the actions' ranges, over the steps
    that may still be executed. With a `prefix` the policy is told what the robot will do until its chunk is there.
    """

    def __init__(
        self,
        policy: Policy,
        horizon: Horizon,
        nfe: int,
        noise_seed: int,
        device: torch.device | str = "cpu",
        *,
        noise_scale: float = USUAL_NOISE,
        noise: str = FRESH,
        candidates: int = 1,
        clock: Clock | None = None,
        prefix: str = NO_PREFIX,
        tells_jumps: bool = False,
    ) -> None:
        self._policy = policy.eval()
        self._horizon = horizon
        self._clock = clock or Clock(horizon)
        self._nfe = nfe
        self._noise = ReplanningNoise(
            policy.noise_shape, noise_seed, kind=noise, scale=noise_scale, candidates=candidates
        )
        self._prefix = prefix
        self._tells_jumps = tells_jumps
        self._device = torch.device(device)

    def reset(self, env: Environment, seed: int) -> None:
        """Forgets the last episode. `env` has the instruction, and the robot with the limits of its actions.

        Raises UserError where that is another robot than the policy's.
        """
        refuse_other_robot(
            self._policy.robot,
            env.robot,
            self._policy.views,
            of="the policy",
            where=f"The environment {env.name}",
            remedy="Choose a policy that was trained for this robot, or the environment that it was trained for.",
        )
        self._minimum = np.array(env.robot.action_min, np.float32)
        self._maximum = np.array(env.robot.action_max, np.float32)
        self._words = tokenize(env.instruction)
        self._noise.reset(seed)
        self._last: tuple[int, np.ndarray] | None = None  # decision and chunk before this one
        self._images: dict[int, list[np.ndarray]] = {}
        self._states: dict[int, np.ndarray] = {}
        self._coming: tuple[int, np.ndarray] | None = None  # decision and chunk that is not there yet
        self._looked_at: int | None = (
            None  # the last step that was looked at, or at which nothing was to be seen
        )
        decay = self._horizon.ensemble
        self._ensemble = None if decay is None else TemporalEnsemble(decay)

    def look(self, env: Environment, state: np.ndarray, step: int) -> Question | None:
        """Sees of `step` what the clock says; what the policy is asked there, None where no decision is due.

        `act` does so itself. Who calls it before, for the same step, owes a question its answer: `take`.
        """
        self._looked_at, self._seen, self._taken = step, None, None
        self._receive(step)
        if self._clock.is_observed(step):
            self._seen = env.look()
            self._images[step] = [self._seen[view] for view in self._policy.views]
            self._states[step] = state
        if not self._clock.is_decision(step):
            return None
        steps = self._horizon.observed_steps(step)
        self._images = {s: self._images[s] for s in steps}
        self._states = {s: self._states[s] for s in steps}
        return self._question(
            [self._images[s] for s in steps],
            [self._states[s] for s in steps],
            self._clock.number(step),
            self._advance(step),
        )

    def take(self, samples: np.ndarray, inference_ms: float) -> None:
        """The answer to the last question: samples (N, Tp, A) and the time that they took."""
        self._taken = self._chosen(samples, self._advance(self._looked_at)), inference_ms

    def act(self, env: Environment, state: np.ndarray, step: int) -> Decision:
        """The action of `step`; looks and replans where the clock says so.

        Raises:
          ActionError: the part of the chunk that would be executed is not finite, or far outside the limits.
        """
        if self._looked_at != step and (question := self.look(env, state, step)) is not None:
            (samples,), inference_ms = self.ask([question])
            self.take(samples, inference_ms)
        chunk = inference_ms = jump = None
        if self._taken is not None:
            chunk, inference_ms = self._taken
            self._check(chunk[self._clock.executed(step)])
            jump = self._jump(chunk, step) if self._tells_jumps else None
            self.remember(step, chunk)
            self._coming = (step, chunk)
            self._receive(step)
        if self._coming is None or self._clock.meanwhile == CONTINUE:
            self._target = self._planned(step)
        action = self._target
        return Decision(action, action, self._seen, chunk, inference_ms, jump)

    def remember(self, step: int, chunk: np.ndarray) -> None:
        """The chunk (Tp, A) decided at `step` becomes the last one, which the next one follows."""
        self._last = (step, chunk)

    def _jump(self, chunk: np.ndarray, step: int) -> float | None:
        """How far a chunk is from the last one; None where there is none, or none that reaches so far."""
        if self._last is None:
            return None
        (found,) = self._distances(chunk[None], step - self._last[0], self._decided)
        return None if np.isnan(found) else float(found)

    def _distances(self, chunks: np.ndarray, advance: int, first: int = 0) -> np.ndarray:
        return distances(chunks, self._last[1], advance, self._maximum - self._minimum, first)

    @property
    def _decided(self) -> int:
        """Steps of a chunk that will have been executed from the last one when it is there."""
        return self._clock.delay if self._clock.meanwhile == CONTINUE else 0

    def _known(self, advance: int) -> Known | None:
        """What the robot does by its last chunk, `advance` steps after that was decided: the chunk on the move."""
        if self._prefix == NO_PREFIX or self._last is None or advance >= len(self._last[1]):
            return None
        going_on = np.clip(self._last[1][advance:], self._minimum, self._maximum)
        steps = len(self._last[1])
        padded = np.concatenate((going_on, np.repeat(going_on[-1:], steps - len(going_on), axis=0)))
        weights = soft_weights(steps, self._decided, len(going_on)) if self._prefix == GUIDED else None
        return Known(torch.from_numpy(padded.astype(np.float32)).to(self._device), self._decided, weights)

    def _receive(self, step: int) -> None:
        """Takes the chunk that is there from `step` on, if any."""
        if self._coming is not None and self._clock.arrival(self._coming[0]) == step:
            self._decided_at, self._chunk = self._coming
            self._coming = None
            if self._ensemble is not None:
                self._ensemble.add(self._decided_at, self._chunk)

    def _planned(self, step: int) -> np.ndarray:
        """What the present chunk, or all that cover `step`, say: float32 (A,) within the limits."""
        if self._ensemble is None:
            action = self._chunk[self._clock.entry(step, self._decided_at)]
        else:
            action = self._ensemble.action(step)
        return np.clip(action, self._minimum, self._maximum).astype(np.float32)

    def plan(
        self,
        images: Sequence[Sequence[np.ndarray]],
        states: Sequence[np.ndarray],
        replanning: int,
        advance: int = 0,
    ) -> tuple[np.ndarray, float]:
        """From the V pictures of each of To steps, uint8 (H, W, 3) of any size, and states, float32 (S,), to a chunk.

        `advance` is the number of steps since the last decision.
        Returns the chunk, float32 (Tp, A), and the time from these arrays to that one [ms].
        """
        (samples,), took_ms = self.ask([self._question(images, states, replanning, advance)])
        return self._chosen(samples, advance), took_ms

    def ask(self, questions: Sequence[Question | None]) -> tuple[list[np.ndarray | None], float]:
        """What this actor's policy answers to questions of its own, or of other actors of the same kind."""
        return answers(self._policy, questions, self._nfe, self._device, derives=self._prefix == GUIDED)

    def _question(
        self,
        images: Sequence[Sequence[np.ndarray]],
        states: Sequence[np.ndarray],
        replanning: int,
        advance: int,
    ) -> Question:
        began = time.perf_counter()
        observation = observation_of(images, states, self._words, self._policy.image_size)
        noise, known = self._noise.draw(replanning, advance), self._known(advance)
        return Question(observation, noise, known, 1e3 * (time.perf_counter() - began))

    def _chosen(self, samples: np.ndarray, advance: int) -> np.ndarray:
        """Of samples (N, Tp, A) the one nearest to the last chunk; the first where there is none."""
        if len(samples) == 1 or self._last is None:
            return samples[0]
        return samples[int(np.argmin(np.nan_to_num(self._distances(samples, advance), nan=0.0)))]

    def _advance(self, step: int) -> int:
        """Steps since the last decision, 0 where there was none."""
        return 0 if self._last is None else step - self._last[0]

    def _check(self, actions: np.ndarray) -> None:
        if not np.isfinite(actions).all():
            raise ActionError(NON_FINITE)
        margin = FAR * (self._maximum - self._minimum)
        if (actions < self._minimum - margin).any() or (actions > self._maximum + margin).any():
            raise ActionError(FAR_OUT_OF_RANGE)
