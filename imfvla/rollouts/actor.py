"""ChunkActor: a policy that looks, predicts a chunk of actions, executes its first entries and looks again.

Shapes: To observed steps, V views, H W pixels, S state, Tp predicted steps, A action.
"""

import time
from collections.abc import Sequence

import numpy as np
import torch

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, USUAL_NOISE
from imfvla.data.resample import resample
from imfvla.environment import Environment
from imfvla.environments.rollout import FAR_OUT_OF_RANGE, NON_FINITE, ActionError
from imfvla.episode import Decision
from imfvla.policy import Policy
from imfvla.policy.noise import chunk_noise
from imfvla.rollouts.clock import Clock
from imfvla.rollouts.ensemble import TemporalEnsemble
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
    the same shape see the same noise. It is multiplied by `noise_scale`.
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
        clock: Clock | None = None,
    ) -> None:
        self._policy = policy.eval()
        self._horizon = horizon
        self._clock = clock or Clock(horizon)
        self._nfe = nfe
        self._noise_seed, self._noise_scale = noise_seed, noise_scale
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
        self._instruction = torch.from_numpy(tokenize(env.instruction)).unsqueeze(0).to(self._device)
        self._seed = seed
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
        images = chunk = inference_ms = None
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
                [self._images[s] for s in steps], [self._states[s] for s in steps], self._clock.number(step)
            )
            self._check(chunk[self._clock.executed(step)])
            self._coming = (step, chunk)
            self._receive(step)
        if self._coming is None or self._clock.meanwhile == CONTINUE:
            self._target = self._planned(step)
        action = self._target
        return Decision(action=action, executed=action, images=images, chunk=chunk, inference_ms=inference_ms)

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

    @torch.inference_mode()
    def plan(
        self, images: Sequence[Sequence[np.ndarray]], states: Sequence[np.ndarray], replanning: int
    ) -> tuple[np.ndarray, float]:
        """From the V pictures of each of To steps, uint8 (H, W, 3) of any size, and states, float32 (S,), to a chunk.

        Returns the chunk, float32 (Tp, A), and the time from these arrays to that one [ms].
        """
        began = time.perf_counter()
        size = self._policy.image_size
        fitted = np.stack([[resample(picture, size) for picture in step] for step in images])
        pixels = torch.from_numpy(fitted).permute(0, 1, 4, 2, 3).unsqueeze(0)
        observation = Observation(
            images=pixels.to(self._device),
            state=torch.from_numpy(np.stack(states)).unsqueeze(0).to(self._device),
            instruction=self._instruction,
        )
        place = (self._noise_seed, self._seed, replanning)
        noise = self._noise_scale * chunk_noise(self._policy.noise_shape, [place])
        chunk = self._policy.predict(observation, noise.to(self._device), self._nfe)
        answer = chunk[0].float().cpu().numpy()  # waits for an accelerator
        return answer, 1e3 * (time.perf_counter() - began)

    def _check(self, actions: np.ndarray) -> None:
        if not np.isfinite(actions).all():
            raise ActionError(NON_FINITE)
        margin = FAR * (self._maximum - self._minimum)
        if (actions < self._minimum - margin).any() or (actions > self._maximum + margin).any():
            raise ActionError(FAR_OUT_OF_RANGE)
