"""When a policy decides, when its chunk is there, and which entry of it is executed at a step, on either clock.

On a running clock a chunk that was asked for at step s, from what was seen there, is there at step s + delay. Until
then the robot holds its last target, so that the chunk is executed from its first entry on, or it continues with its
present chunk, so that the new one is executed from its entry `delay` on. The first chunk of an episode is waited for:
a robot that does not know yet what to do stands still, and no clock runs. With a delay of 0 both clocks are one.
"""

import math
from dataclasses import dataclass

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, GUIDED, HOLD, MOST_DELAY_MS, NO_PREFIX, TRAINED
from imfvla.errors import UserError

FIRST = 0  # step of the first decision, whose chunk is waited for


@dataclass(frozen=True, slots=True)
class Clock:
    """Decisions and entries for chunks of `horizon` that arrive `delay` control steps after they are asked for.

    `delay_steps` refuses what a horizon cannot bear.
    """

    horizon: Horizon
    delay: int = 0
    meanwhile: str = HOLD

    @property
    def period(self) -> int:
        """Steps from a decision to the next one; the first one is followed by the second after `exec`."""
        if self.meanwhile == HOLD:
            return self.horizon.exec + self.delay
        return max(self.horizon.exec, self.delay)  # one chunk is computed after the other

    def next_decision(self, step: int) -> int:
        """The first step from `step` on at which the policy decides."""
        if step == FIRST:
            return FIRST
        second = FIRST + self.horizon.exec
        return second + max(0, math.ceil((step - second) / self.period)) * self.period

    def is_decision(self, step: int) -> bool:
        """Whether the policy decides at `step`, from what it has seen up to then."""
        return self.next_decision(step) == step

    def is_observed(self, step: int) -> bool:
        """Whether the observation of `step` enters a decision: the steps whose cameras must be rendered."""
        return self.next_decision(step) - step < self.horizon.obs

    def number(self, decision: int) -> int:
        """Which decision of the episode the one at step `decision` is, from 0."""
        return 0 if decision == FIRST else 1 + (decision - FIRST - self.horizon.exec) // self.period

    def arrival(self, decision: int) -> int:
        """The first step at which the chunk of that decision is there."""
        return decision if decision == FIRST else decision + self.delay

    def entry(self, step: int, decision: int) -> int:
        """The entry of the chunk of `decision` that is executed at `step`."""
        return step - (self.arrival(decision) if self.meanwhile == HOLD else decision)

    def executed(self, decision: int) -> slice:
        """The entries of the chunk of `decision` that are executed before the next one is there."""
        if self.meanwhile == HOLD:
            return slice(0, self.horizon.exec)
        if decision == FIRST:
            return slice(0, self.horizon.exec + self.delay)
        return slice(self.delay, self.delay + self.period)


def longest_delay(horizon: Horizon) -> int:
    """The most control steps of delay that a chunk covers while the robot continues with it."""
    return min(horizon.pred - horizon.exec, horizon.pred // 2)


def delay_steps(
    delay_ms: float, control_hz: float, horizon: Horizon, meanwhile: str, prefix: str = NO_PREFIX
) -> int:
    """A delay in control steps, rounded up: a chunk that is late by a moment waits for the next step.

    Raises UserError where the horizon cannot bear it, beyond what an option may say, as a measured one can be, or where
    a policy has learned no prefix that is so long.
    """
    if delay_ms > MOST_DELAY_MS:
        raise UserError(
            f"delay_ms={delay_ms:g} is above {MOST_DELAY_MS}: evaluate with clock=paused, or with a number. A measured "
            "one is kept in latency.json of the run."
        )
    steps = math.ceil(delay_ms * control_hz / 1000 - 1e-9)
    found = (
        f"delay_ms={delay_ms:g} is {steps} control {'step' if steps == 1 else 'steps'} at {control_hz:g} Hz"
    )
    if steps and horizon.ensemble is not None:
        raise UserError(
            f"{found}, but horizon.ensemble needs a new chunk in every step: evaluate with clock=paused, or with "
            "delay_ms=0."
        )
    longest = longest_delay(horizon)
    if meanwhile == CONTINUE and steps > longest:
        raise UserError(
            f"{found}, and with meanwhile=continue at most {longest} are possible "
            f"({1000 * longest / control_hz:g} ms): a chunk of pred={horizon.pred} actions, of which "
            f"exec={horizon.exec} are executed before the policy looks again, covers no more. Lower delay_ms, or set "
            "meanwhile=hold."
        )
    if prefix == TRAINED and steps > horizon.prefix_max:
        learned = f"the policy was trained with horizon.prefix_max={horizon.prefix_max}"
        raise UserError(
            f"{found}, and with prefix={TRAINED} so many actions are given, but {learned}: lower delay_ms, train with "
            f"a larger horizon.prefix_max, or set prefix={NO_PREFIX} or prefix={GUIDED}."
        )
    return steps
