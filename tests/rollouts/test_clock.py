"""The running clock: which observation and which entry of its chunk each executed action came from, in closed form."""

import itertools

import numpy as np
import pytest
import torch
from fakes import ROBOT, FakeEnvironment

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, HOLD, EvaluationOptions
from imfvla.environments.rollout import NON_FINITE, run_episode
from imfvla.errors import UserError
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.clock import Clock, delay_steps, longest_delay

STEPS = 60
UNIT = 64.0  # steps and entries are told as shares of it, within the robot's limits


class TellingPolicy:
    """Each entry of a chunk tells the newest step that was seen, which entry it is, and the NFE."""

    robot, views, image_size = ROBOT, ("front",), (16, 16)

    def __init__(self, horizon: Horizon) -> None:
        self.horizon, self.noise_shape = horizon, (horizon.pred, len(ROBOT.action))
        self.seen: list[list[int]] = []

    def eval(self) -> "TellingPolicy":
        return self

    def predict(self, obs, noise, nfe):
        steps = obs.state[0, :, 0]
        self.seen.append(steps.int().tolist())
        chunk = torch.zeros(1, *self.noise_shape)
        chunk[0, :, 0] = steps[-1] / UNIT
        chunk[0, :, 1] = torch.arange(self.horizon.pred) / UNIT
        chunk[0, :, 2] = nfe / UNIT
        return chunk


def play(clock: Clock, nfe: int = 1) -> tuple[np.ndarray, TellingPolicy, FakeEnvironment]:
    """Of every step, the step that its action was decided from, the entry of the chunk and the NFE: int (STEPS, 3)."""
    env, policy = FakeEnvironment(STEPS), TellingPolicy(clock.horizon)
    actor = ChunkActor(policy, clock.horizon, nfe, noise_seed=0, clock=clock)
    run_episode(env, actor, 0, [], kind="rollout", config={})
    told = UNIT * np.array(env.executed)[:, :3]
    assert (told == told.astype(int)).all()
    return told.astype(int), policy, env


HORIZONS = [(1, 1, 1), (1, 8, 4), (2, 8, 4), (1, 8, 8), (3, 16, 5), (1, 32, 16), (1, 12, 2)]


@pytest.mark.parametrize("nfe", [1, 3])
@pytest.mark.parametrize("horizon", HORIZONS)
def test_holding_executes_each_chunk_whole_after_its_delay(horizon, nfe):
    horizon = Horizon(*horizon)
    for delay in (0, 1, 3, 17):
        told, policy, env = play(Clock(horizon, delay, HOLD), nfe)
        expected = [(0, entry) for entry in range(horizon.exec)]
        for decision in itertools.count(horizon.exec, horizon.exec + delay):
            if len(expected) >= STEPS:
                break
            expected += [expected[-1]] * delay  # the last target
            expected += [(decision, entry) for entry in range(horizon.exec)]
        np.testing.assert_array_equal(told[:, :2], expected[:STEPS])
        assert set(told[:, 2]) == {nfe}
        assert_looks(policy, env, horizon)


@pytest.mark.parametrize("nfe", [1, 3])
@pytest.mark.parametrize("horizon", HORIZONS)
def test_continuing_executes_the_entry_of_the_newest_chunk_that_is_there(horizon, nfe):
    horizon = Horizon(*horizon)
    for delay in range(longest_delay(horizon) + 1):
        told, policy, env = play(Clock(horizon, delay, CONTINUE), nfe)
        decisions = [0, *range(horizon.exec, STEPS, max(horizon.exec, delay))]
        for step in range(STEPS):
            there = [decision for decision in decisions if decision == 0 or decision + delay <= step]
            assert tuple(told[step, :2]) == (there[-1], step - there[-1])
        assert [steps[-1] for steps in policy.seen] == decisions
        assert_looks(policy, env, horizon)


def assert_looks(policy: TellingPolicy, env: FakeEnvironment, horizon: Horizon) -> None:
    """Cameras are rendered at the steps that enter a decision, each once, and at those before the next one."""
    entering = {step for steps in policy.seen for step in steps}
    assert len(env.looked) == len(set(env.looked))
    assert entering <= set(env.looked)
    assert all(step > max(entering) for step in set(env.looked) - entering)
    assert all(steps == horizon.observed_steps(steps[-1]).tolist() for steps in policy.seen)


@pytest.mark.parametrize("meanwhile", [HOLD, CONTINUE])
def test_without_delay_both_clocks_are_one(meanwhile):
    for sizes in HORIZONS:
        horizon = Horizon(*sizes)
        paused, running = Clock(horizon), Clock(horizon, 0, meanwhile)
        for step in range(STEPS):
            assert paused.is_decision(step) == running.is_decision(step) == (step % horizon.exec == 0)
            assert (
                paused.is_observed(step) == running.is_observed(step) == (-step % horizon.exec < horizon.obs)
            )
        assert [paused.number(step) for step in range(0, STEPS, horizon.exec)] == list(
            range(-(-STEPS // horizon.exec))
        )
        np.testing.assert_array_equal(play(paused)[0], play(running)[0])


def test_what_is_never_executed_may_be_anything():
    """Of a chunk that is late, the first entries; of one that is held for, the last ones."""
    for clock, never in ((Clock(Horizon(1, 8, 3), 2, CONTINUE), 1), (Clock(Horizon(1, 8, 3), 2, HOLD), 3)):
        policy = TellingPolicy(clock.horizon)
        predict = policy.predict

        def spoilt(obs, noise, nfe, entry=never, predict=predict):
            chunk = predict(obs, noise, nfe)
            if obs.state[0, -1, 0] > 0:
                chunk[0, entry] = torch.nan
            return chunk

        policy.predict = spoilt
        for executed, failure in ((clock, None), (Clock(Horizon(1, 8, 4)), NON_FINITE)):
            actor = ChunkActor(policy, executed.horizon, 1, noise_seed=0, clock=executed)
            result = run_episode(FakeEnvironment(30), actor, 0, [], kind="rollout", config={})
            assert result.failure == failure


@pytest.mark.parametrize(
    ("delay_ms", "hz", "steps"),
    [(0, 50, 0), (0.1, 50, 1), (20, 50, 1), (20.1, 50, 2), (300, 50, 15), (340, 50, 17), (70, 10, 1)],
)
def test_delays_are_rounded_up_to_control_steps(delay_ms, hz, steps):
    assert delay_steps(delay_ms, hz, Horizon(1, 64, 16), HOLD) == steps


@pytest.mark.parametrize("sizes", [(1, 32, 16), (1, 16, 8), (1, 8, 8), (1, 32, 8), (1, 9, 2), (1, 1, 1)])
def test_the_longest_delay_is_the_longest_that_the_chunks_cover(sizes):
    horizon = Horizon(*sizes)
    longest = longest_delay(horizon)
    for delay in range(horizon.pred + 2):
        clock = Clock(horizon, delay, CONTINUE)
        covered = all(clock.executed(d).stop <= horizon.pred for d in (0, horizon.exec))
        assert covered == (delay <= longest)


def test_a_delay_that_no_chunk_covers_is_refused_with_the_longest_one():
    horizon = Horizon(1, 32, 16)
    assert delay_steps(320, 50, horizon, CONTINUE) == 16
    assert delay_steps(340, 50, horizon, HOLD) == 17
    with pytest.raises(UserError, match=r"delay_ms=1e\+12 is above 10000: .* latency.json"):
        delay_steps(1e12, 50, horizon, HOLD)
    with pytest.raises(
        UserError, match=r"delay_ms=340 is 17 control steps at 50 Hz.* at most 16 are possible \(320 ms\)"
    ):
        delay_steps(340, 50, horizon, CONTINUE)
    with pytest.raises(UserError, match=r"horizon\.ensemble needs a new chunk in every step"):
        delay_steps(20, 50, Horizon(1, 8, 1, ensemble=0.01), HOLD)
    assert delay_steps(0, 50, Horizon(1, 8, 1, ensemble=0.01), CONTINUE) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delay_ms": -1}, r"delay_ms must be measured, or a number of ms between 0 and 10000, found -1"),
        ({"delay_ms": float("nan")}, r"delay_ms must be a finite number, found nan"),
        ({"delay_ms": 1e9}, r"between 0 and 10000"),
        ({"delay_ms": "soon"}, r"delay_ms must be measured, or"),
        ({"meanwhile": "wait"}, r"meanwhile must be one of hold, continue"),
        ({"clock": "fast"}, r"clock must be one of paused, running"),
        (
            {"clock": "paused", "delay_ms": 20},
            r"delay_ms must be measured with clock=paused: set clock=running",
        ),
        ({"clock": "paused", "meanwhile": "continue"}, r"meanwhile must be hold with clock=paused"),
    ],
)
def test_wrong_options_are_named(options, message):
    from imfvla.options import build

    given = {"episodes": 1, "first_seed": 0, "nfe": [1], "clock": "running"} | options
    with pytest.raises(UserError, match=message):
        build(EvaluationOptions, given, "")
