"""Chunks that begin with what the robot did while they were computed, in closed loop."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import LIMIT, ROBOT, FakeEnvironment, KnownPolicy, build_fakes

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, HOLD, EvaluationOptions, Protocol, unusual
from imfvla.environments.rollout import run_episode
from imfvla.errors import UserError
from imfvla.generators.base import UniformTimes
from imfvla.generators.flow import FlowMatching
from imfvla.generators.inpainting import Target, soft_weights
from imfvla.options import build
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.clock import Clock, delay_steps, longest_delay
from imfvla.rollouts.latency import latency_of

STEPS = 60


class GoingOnPolicy:
    """Chunks are noise, behind the decided actions that it is told; keeps what it is told at each decision."""

    robot, views, image_size = ROBOT, ("front",), (16, 16)

    def __init__(self, horizon, spoils=0.0):
        self.horizon, self.noise_shape, self._spoils = horizon, (horizon.pred, len(ROBOT.action)), spoils
        self.told = {}

    def eval(self):
        return self

    def predict(self, obs, noise, nfe, known=None):
        self.told[int(obs.state[0, -1, 0])] = known
        chunk = noise + self._spoils
        if known is not None:
            chunk[:, : known.decided] = known.actions[: known.decided]
        return chunk


def play(policy, clock, **options):
    env = FakeEnvironment(STEPS)
    actor = ChunkActor(
        policy, policy.horizon, options.pop("nfe", 1), 0, clock=clock, tells_jumps=True, **options
    )
    result = run_episode(env, actor, 3, [], kind="rollout", config={})
    return np.array(env.executed), result


HORIZONS = [(1, 8, 4), (2, 8, 4), (3, 16, 5), (1, 32, 16), (1, 12, 2), (1, 1, 1)]


@pytest.mark.parametrize("sizes", HORIZONS)
@pytest.mark.parametrize("prefix", ["guided", "trained"])
def test_a_chunk_begins_with_what_the_robot_does_until_it_is_there(prefix, sizes):
    horizon = Horizon(*sizes)
    for delay in range(longest_delay(horizon) + 1):
        policy = GoingOnPolicy(horizon, spoils=3.0)  # beyond the limits: what is executed is clipped
        executed, _ = play(policy, Clock(horizon, delay, CONTINUE), prefix=prefix)
        assert policy.told.pop(0) is None  # nothing is decided at the start
        last = 0
        for step, known in policy.told.items():
            if horizon.exec == horizon.pred:
                assert known is None  # chunks share no step
                continue
            assert known.decided == delay
            ends = min(delay, STEPS - step)
            np.testing.assert_array_equal(known.actions[:ends].numpy(), executed[step : step + ends])
            assert known.actions.abs().max() <= LIMIT
            assert known.actions.shape == policy.noise_shape
            if prefix == "guided":
                covered = horizon.pred - (step - last)
                assert torch.equal(known.weights, soft_weights(horizon.pred, delay, covered))
            else:
                assert known.weights is None
            last = step


def test_without_a_prefix_a_policy_is_told_nothing():
    policy = GoingOnPolicy(Horizon(1, 8, 4))
    play(policy, Clock(policy.horizon, 2, CONTINUE))
    assert set(policy.told.values()) == {None}


class TwoWays:
    """The exact flow of chunks that are all `size` or all -`size`, which noise chooses between."""

    robot, views, image_size, size = ROBOT, ("front",), (16, 16), 0.5

    def __init__(self, horizon):
        self.horizon, self.noise_shape = horizon, (horizon.pred, len(ROBOT.action))
        self.generator = FlowMatching(
            parametrisation="data", times=UniformTimes(), time_power=2.0, adaptive_power=0.0,
            adaptive_offset=1e-3, draws=1, clip=5.0,
        )  # fmt: skip

    def eval(self):
        return self

    def core(self, z, t, r, context):
        evidence = self.size * z.sum(dim=(1, 2)) * (1 - t) / t**2
        return self.size * evidence.tanh()[:, None, None] * torch.ones_like(z)

    def predict(self, obs, noise, nfe, known=None):
        if known is None:
            return self.generator.sample(self.core, None, noise, nfe)
        target = Target(known.actions.unsqueeze(0), known.weights)
        chunk = self.generator.inpaint(self.core, None, noise, nfe, target)
        chunk[:, : known.decided] = known.actions[: known.decided]
        return chunk


def test_guided_chunks_go_on_the_way_that_was_begun():
    horizon = Horizon(1, 8, 3)
    clock = Clock(horizon, 2, CONTINUE)
    (free, jumping), (guided, smooth) = (
        play(TwoWays(horizon), clock, nfe=10, prefix=prefix) for prefix in ("none", "guided")
    )
    assert (np.sign(free[:, 0]) != np.sign(free[0, 0])).any()
    assert (np.sign(guided[:, 0]) == np.sign(guided[0, 0])).all()
    assert smooth.chunk_jump < jumping.chunk_jump / 10


def test_jumps_are_those_of_the_steps_that_may_still_be_executed():
    """Decided actions are equal in both chunks, whether the policy is told them or not."""
    horizon = Horizon(1, 8, 4)

    class Decided(GoingOnPolicy):
        def predict(self, obs, noise, nfe, known=None):
            chunk = 0 * noise
            chunk[:, :2] = float(obs.state[0, -1, 0]) / STEPS  # never executed, but for the first chunk
            return chunk

    assert play(Decided(horizon), Clock(horizon, 2, CONTINUE))[1].chunk_jump == 0
    assert play(Decided(horizon), Clock(horizon, 1, CONTINUE))[1].chunk_jump > 0


def test_a_longer_delay_than_was_learned_is_refused():
    horizon = Horizon(1, 32, 16, prefix_max=4)
    assert delay_steps(80, 50, horizon, CONTINUE, "trained") == 4
    assert delay_steps(100, 50, horizon, CONTINUE, "guided") == 5
    with pytest.raises(UserError, match=r"is 5 control steps .* trained with horizon\.prefix_max=4: lower"):
        delay_steps(100, 50, horizon, CONTINUE, "trained")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefix": "soft"}, r"prefix must be one of none, guided, trained"),
        ({"prefix": "guided"}, r"prefix must be none unless the robot goes on meanwhile"),
        (
            {"prefix": "trained", "clock": "running", "meanwhile": HOLD},
            r"set clock=running meanwhile=continue",
        ),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(UserError, match=message):
        build(EvaluationOptions, {"episodes": 1, "first_seed": 0, "nfe": [1]} | options, "")


def test_a_prefix_is_part_of_the_protocol_and_of_its_names():
    options = {"clock": "running", "delay_ms": 40, "meanwhile": "continue", "prefix": "guided"}
    asked = build(EvaluationOptions, {"episodes": 1, "first_seed": 0, "nfe": [2]} | options, "")
    told = Protocol("fake", "default", 20, "0", 2, **asked.in_protocol(), delay_steps=2)
    assert told.name(20) == "seeds0-0_nfe2_delay40-continue-guided"
    assert unusual(vars_of(told)) == ("delay 40 ms (2 steps), continue", "guided prefix")


def vars_of(protocol):
    return {name: getattr(protocol, name) for name in protocol.__slots__}


def test_times_are_kept_for_each_prefix_and_older_ones_are_those_without(tmp_path: Path):
    from imfvla.storage.run_directory import RunDirectory

    run = RunDirectory(tmp_path)
    protocol = Protocol("fake", "default", 20, "0123", 2, 0, 1.0, 0, 1, None, "cpu", clock="running")
    taken = iter((1.0, 2.0))

    def measure():
        return {"median_ms": next(taken), "p95_ms": 3.0, "calls": 20, "at": "now", "load": 0.5}

    assert latency_of(run, protocol, measure)["median_ms"] == 1
    (kept,) = json.loads((tmp_path / "latency.json").read_text())
    del kept["prefix"]
    (tmp_path / "latency.json").write_text(json.dumps([kept]))
    assert latency_of(run, protocol, measure)["median_ms"] == 1
    assert latency_of(run, replace(protocol, prefix="guided"), measure)["median_ms"] == 2


def test_a_policy_that_cannot_is_refused_before_an_episode_begins(tmp_path: Path, monkeypatch):
    from imfvla.rollouts.workbench import Job, describe_world

    def refuse(self, nfe, candidates, prefix):
        raise UserError(f"prefix={prefix} with {candidates} candidates")

    monkeypatch.setattr(KnownPolicy, "check_replanning", refuse)
    protocol = Protocol("fake", "default", 20, "0", 1, 0, 1.0, 0, 1, None, "cpu", candidates=2)
    with pytest.raises(UserError, match="prefix=none with 2 candidates"):
        describe_world(Job(build_fakes, tmp_path, protocol))
