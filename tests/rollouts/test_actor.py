"""ChunkActor: looks when it must, and executes exactly the entries of the chunk that the horizon says."""

import numpy as np
import pytest
from fakes import LIMIT, FakeEnvironment, KnownPolicy, known_actions
from hypothesis import given, settings
from hypothesis import strategies as st

from imfvla.config.horizon import Horizon
from imfvla.environments.rollout import FAR_OUT_OF_RANGE, NON_FINITE, run_episode
from imfvla.rollouts.actor import FAR, ChunkActor
from imfvla.rollouts.clock import Clock

horizons = st.integers(1, 5).flatmap(
    lambda obs: st.integers(1, 9).flatmap(
        lambda pred: st.integers(1, pred).map(lambda execute: Horizon(obs, pred, execute))
    )
)


def play(
    policy: KnownPolicy, *, num_steps: int = 30, seed: int = 5, nfe: int = 2, noise_seed: int = 0, **options
):
    env = FakeEnvironment(num_steps)
    actor = ChunkActor(policy, policy.horizon, nfe, noise_seed, **options)
    result = run_episode(env, actor, seed, [], kind="rollout", config={})
    return env, result


@settings(max_examples=60, deadline=None)
@given(horizon=horizons, num_steps=st.integers(1, 30))
def test_known_actions_pass_through_policy_and_actor(horizon: Horizon, num_steps: int):
    actions = known_actions(num_steps)
    policy = KnownPolicy(horizon, actions)
    env, result = play(policy, num_steps=num_steps)
    np.testing.assert_array_equal(env.executed, actions)
    decisions = range(0, num_steps, horizon.exec)
    assert [list(steps) for steps in policy.seen] == [
        list(horizon.observed_steps(step)) for step in decisions
    ]
    assert set(env.looked) >= {step for steps in policy.seen for step in steps}
    assert len(env.looked) == len(set(env.looked)) == sum(map(Clock(horizon).is_observed, range(num_steps)))
    assert len(result.inference_ms) == len(decisions)
    assert set(policy.evaluations) == {2}


def test_the_executed_action_is_the_entry_of_the_newest_chunk():
    policy = KnownPolicy(Horizon(1, 8, 3), known_actions(30), noise_scale=0.3)
    env = FakeEnvironment(30)
    actor = ChunkActor(policy, policy.horizon, nfe=1, noise_seed=0)
    env.reset(seed=1)
    actor.reset(env, 1)
    chunk = None
    for step in range(30):
        decision = actor.act(env, env.state(), step)
        assert (decision.chunk is None) == (decision.images is None) == (step % 3 != 0)
        chunk = chunk if decision.chunk is None else decision.chunk
        np.testing.assert_array_equal(decision.executed, chunk[step % 3])
        env.step(decision.executed)


def test_noise_depends_on_noise_seed_episode_and_replanning_alone():
    def noises(**options) -> list[np.ndarray]:
        policy = KnownPolicy(Horizon(1, 8, 4), known_actions(40))
        play(policy, **options)
        return policy.noises

    reference = noises()
    assert len({noise.tobytes() for noise in reference}) == len(reference)
    np.testing.assert_array_equal(reference, noises(nfe=3))
    np.testing.assert_array_equal(reference[:3], noises(num_steps=12))
    assert not np.array_equal(reference[0], noises(seed=6)[0])
    assert not np.array_equal(reference[0], noises(noise_seed=1)[0])
    draw = np.random.default_rng(np.random.SeedSequence([0, 5, 1])).standard_normal((8, 16), dtype=np.float32)
    np.testing.assert_array_equal(reference[1], draw)
    np.testing.assert_array_equal(0.5 * np.array(reference), noises(noise_scale=0.5))


def test_actions_are_clipped_to_the_limits():
    env, result = play(KnownPolicy(Horizon(1, 8, 4), known_actions(30) + np.float32(2 * LIMIT)))
    assert result.failure is None
    np.testing.assert_array_equal(env.executed, np.full((30, 16), LIMIT, np.float32))


@pytest.mark.parametrize(
    ("value", "label"),
    [(np.nan, NON_FINITE), (-np.inf, NON_FINITE), (LIMIT + 2 * LIMIT * FAR + 1, FAR_OUT_OF_RANGE)],
)
def test_a_chunk_that_cannot_be_executed_ends_the_episode_with_a_label(value, label):
    actions = known_actions(30)
    actions[10, 3] = value
    _, result = play(KnownPolicy(Horizon(1, 8, 4), actions))
    assert (result.failure, result.num_steps, result.success) == (label, 8, False)


def test_what_is_predicted_but_never_executed_does_no_harm():
    policy = KnownPolicy(Horizon(1, 8, 4), known_actions(32))
    policy.actions[30:] = np.nan
    _, result = play(policy, num_steps=26)
    assert result.failure is None
