"""Temporal ensembling: the offline weighted mean, step by step, in the actor too."""

import numpy as np
import pytest
from fakes import FakeEnvironment, KnownPolicy, known_actions

from imfvla.config.horizon import Horizon
from imfvla.errors import UserError
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.ensemble import TemporalEnsemble


@pytest.mark.parametrize("decay", [0.0, 0.01, 1.0])
def test_equals_the_weighted_mean_of_all_chunks_that_cover_a_step(decay):
    chunks = np.random.default_rng(0).normal(size=(9, 4, 2))
    ensemble = TemporalEnsemble(decay)
    for step, chunk in enumerate(chunks):
        ensemble.add(step, chunk)
        covering = [chunks[began][step - began] for began in range(max(0, step - 3), step + 1)]
        weights = [np.exp(-decay * i) for i in range(len(covering))]
        np.testing.assert_allclose(ensemble.action(step), np.average(covering, axis=0, weights=weights))


def test_the_actor_executes_the_mean():
    policy = KnownPolicy(Horizon(1, 4, 1, ensemble=0.01), known_actions(12), noise_scale=0.3)
    env, ensemble = FakeEnvironment(12), TemporalEnsemble(0.01)
    actor = ChunkActor(policy, policy.horizon, nfe=1, noise_seed=0)
    env.reset(seed=1)
    actor.reset(env, 1)
    for step in range(12):
        decision = actor.act(env, env.state(), step)
        ensemble.add(step, decision.chunk)
        expected = np.clip(ensemble.action(step), env.robot.action_min, env.robot.action_max)
        np.testing.assert_allclose(decision.executed, expected, rtol=1e-6)
        env.step(decision.executed)


def test_needs_a_decision_at_every_step():
    with pytest.raises(UserError, match=r"horizon\.ensemble .* needs horizon\.exec=1 .* found exec=2"):
        Horizon(1, 4, 2, ensemble=0.01)
