"""ChunkActor: a policy that looks, predicts a chunk of actions, executes its first entries and looks again.

Shapes: To observed steps, V views, H W pixels, S state, Tp predicted steps, A action.
"""

import time
from collections.abc import Sequence

import numpy as np
import torch

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, FRESH, GUIDED, NO_PREFIX, USUAL_NOISE
from imfvla.data.resample import resample
from imfvla.environment import Environment
from imfvla.environments.rollout import FAR_OUT_OF_RANGE, NON_FINITE, ActionError
from imfvla.episode import Decision
from imfvla.generators.inpainting import soft_weights
from imfvla.policy import Policy
from imfvla.policy.prefix import Known
from imfvla.rollouts.clock import Clock
from imfvla.rollouts.ensemble import TemporalEnsemble
from imfvla.rollouts.noise import ReplanningNoise, distances
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.types import Observation, tokenize

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
        decay = self._horizon.ensemble
        self._ensemble = None if decay is None else TemporalEnsemble(decay)

    def act(self, env: Environment, state: np.ndarray, step: int) -> Decision:
        """The action of `step`; looks and replans where the clock says so.

        Raises:
          ActionError: the part of the chunk that would be executed is not finite, or far outside the limits.
        """
        images = chunk = inference_ms = jump = None
        self._receive(step)
        if self._clock.is_observed(step):
            images = env.look()
            self._images[step] = [images[view] for view in self._policy.views]
            self._states[step] = state
        if self._clock.is_decision(step):
            steps = self._horizon.observed_steps(step)
            self._images = {s: self._images[s] for s in steps}
            self._states = {s: self._states[s] for s in steps}
            chunk, inference_ms = self.plan(
                [self._images[s] for s in steps],
                [self._states[s] for s in steps],
                self._clock.number(step),
                0 if self._last is None else step - self._last[0],
            )
            self._check(chunk[self._clock.executed(step)])
            jump = self._jump(chunk, step) if self._tells_jumps else None
            self.remember(step, chunk)
            self._coming = (step, chunk)
            self._receive(step)
        if self._coming is None or self._clock.meanwhile == CONTINUE:
            self._target = self._planned(step)
        action = self._target
        return Decision(action, action, images, chunk, inference_ms, jump)

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
        began = time.perf_counter()
        observation = observation_of(images, states, self._words, self._policy.image_size).to(self._device)
        noise = self._noise.draw(replanning, advance)
        known = self._known(advance)
        # The guidance is a derivative, which inference mode does not allow.
        with torch.no_grad() if self._prefix == GUIDED else torch.inference_mode():
            told = {} if known is None else {"known": known}
            chunks = self._policy.predict(observation, noise.to(self._device), self._nfe, **told)
            answers = chunks.float().cpu().numpy()  # waits for an accelerator
        chosen = 0
        if len(answers) > 1 and self._last is not None:
            chosen = int(np.argmin(np.nan_to_num(self._distances(answers, advance), nan=0.0)))
        answer = answers[chosen]
        return answer, 1e3 * (time.perf_counter() - began)

    def _check(self, actions: np.ndarray) -> None:
        if not np.isfinite(actions).all():
            raise ActionError(NON_FINITE)
        margin = FAR * (self._maximum - self._minimum)
        if (actions < self._minimum - margin).any() or (actions > self._maximum + margin).any():
            raise ActionError(FAR_OUT_OF_RANGE)


def observation_of(
    images: Sequence[Sequence[np.ndarray]],
    states: Sequence[np.ndarray],
    words: np.ndarray,
    size: tuple[int, int],
) -> Observation:
    """What a policy sees, of batch 1, from the V pictures and the state of each of To steps and word ids int64 (L,).

    Pictures are uint8 (H, W, 3) of any size, and are brought to `size` (H, W).
    """
    fitted = np.stack([[resample(picture, size) for picture in step] for step in images])
    return Observation(
        images=torch.from_numpy(fitted).permute(0, 1, 4, 2, 3).unsqueeze(0),
        state=torch.from_numpy(np.stack(states)).unsqueeze(0),
        instruction=torch.from_numpy(words).unsqueeze(0),
    )
