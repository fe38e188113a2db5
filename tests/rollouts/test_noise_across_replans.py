"""Noise over replannings, the best of several candidates, and the jumps between consecutive chunks."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from fakes import LIMIT, FakeEnvironment, KnownPolicy, build_fakes, known_actions
from small_policy import policy as small_policy

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import EvaluationOptions, Protocol
from imfvla.environments.rollout import run_episode
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.policy.noise import chunk_noise
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.noise import ReplanningNoise, distances
from imfvla.rollouts.workbench import Job, roll_out

SHAPE = (8, 3)


def drawn(
    kind: str, advance: int = 4, number: int = 5, scale: float = 1.0, candidates: int = 1
) -> list[torch.Tensor]:
    noise = ReplanningNoise(SHAPE, 2, kind=kind, scale=scale, candidates=candidates)
    noise.reset(7)
    return [noise.draw(k, advance if k else 0) for k in range(number)]


def test_fresh_noise_is_that_of_each_replanning():
    for k, found in enumerate(drawn("fresh", scale=0.5)):
        torch.testing.assert_close(found, 0.5 * chunk_noise(SHAPE, [(2, 7, k)]), rtol=0, atol=0)


def test_held_noise_is_that_of_the_first_replanning():
    first, *others = drawn("held")
    torch.testing.assert_close(first, chunk_noise(SHAPE, [(2, 7, 0)]), rtol=0, atol=0)
    assert all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize("advance", [1, 3, 7, 8])
def test_rolled_noise_follows_the_steps_and_is_fresh_at_the_end(advance):
    rolled, fresh = drawn("rolled", advance), drawn("fresh", advance)
    assert torch.equal(rolled[0], fresh[0])
    for k in range(1, len(rolled)):
        assert torch.equal(rolled[k][:, : 8 - advance], rolled[k - 1][:, advance:])
        assert torch.equal(rolled[k][:, 8 - advance :], fresh[k][:, 8 - advance :])


def test_zero_noise_and_a_new_episode():
    assert not torch.stack(drawn("zero")).any()
    noise = ReplanningNoise(SHAPE, 2, kind="rolled", scale=1.0, candidates=1)
    for seed in (7, 8):
        noise.reset(seed)
        assert torch.equal(noise.draw(0, 0), chunk_noise(SHAPE, [(2, seed, 0)]))
        noise.draw(1, 4)


def test_the_first_candidate_has_the_noise_that_it_would_have_alone():
    for alone, many in zip(drawn("fresh"), drawn("fresh", candidates=4), strict=True):
        assert many.shape == (4, *SHAPE)
        assert torch.equal(many[:1], alone)
        assert len({candidate.numpy().tobytes() for candidate in many}) == 4


def test_distances_are_over_the_steps_that_both_chunks_cover():
    last, chunk = np.zeros((4, 2)), np.ones((1, 4, 2))
    chunk[0, 3] = 100  # covered by the new chunk alone
    np.testing.assert_allclose(distances(chunk, last, 1, np.array([1.0, 2.0])), np.sqrt((1 + 0.25) / 2))
    assert np.isnan(distances(chunk, last, 4, np.ones(2))).all()


def play(candidates: int = 1, **options):
    policy = KnownPolicy(Horizon(1, 8, 4), known_actions(40), noise_scale=0.3)
    actor = ChunkActor(
        policy, policy.horizon, 1, noise_seed=0, candidates=candidates, tells_jumps=True, **options
    )
    chunks = []

    class Spy:
        def begin(self, env, info): ...
        def step(self, env, step):
            chunks.extend([] if step.decision.chunk is None else [step.decision.chunk])

        def end(self, result): ...
        def abort(self): ...

    result = run_episode(FakeEnvironment(40), actor, 3, [Spy()], kind="rollout", config={})
    return policy, chunks, result


def test_the_candidate_nearest_to_the_last_chunk_is_executed():
    policy, chunks, _ = play(candidates=5)
    assert policy.drawn[0].shape[0] == 5
    assert len(policy.seen) == 10  # one pass for all candidates
    for k in range(1, 10):
        rows, _ = policy.horizon.action_steps(4 * k, 40)
        samples = policy.actions[rows] + 0.3 * policy.drawn[k]
        error = [np.square(sample[:4] - chunks[k - 1][4:]).mean() for sample in samples]
        np.testing.assert_allclose(chunks[k], samples[int(np.argmin(error))], rtol=1e-6)


def test_jumps_are_recorded_and_smaller_among_several_candidates():
    _, chunks, alone = play()
    expected = [np.sqrt(np.square((b[:4] - a[4:]) / (2 * LIMIT)).mean()) for a, b in pairwise(chunks)]
    assert alone.chunk_jump == pytest.approx(np.mean(expected), rel=1e-5)
    assert play(candidates=8)[2].chunk_jump < alone.chunk_jump
    assert play(noise="zero")[2].chunk_jump == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": "pink"}, r"noise must be one of fresh, held, rolled, zero"),
        ({"candidates": 0}, r"candidates must be between 1 and 64"),
        ({"candidates": 8, "noise": "held"}, r"candidates must be 1 unless noise is fresh"),
        ({"candidates": 8, "noise_scale": 0}, r"candidates must be 1 unless noise is fresh"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(UserError, match=message):
        build(EvaluationOptions, {"episodes": 1, "first_seed": 0, "nfe": [1]} | options, "")


def test_noise_that_later_steps_draw_anew_cannot_be_rolled():
    generator = {
        "_target_": "imfvla.generators.ddpm.DenoisingDiffusion",
        "num_levels": 10,
        "prediction": "sample",
        "clip_sample": True,
        "draws": 1,
        "clip": 1.0,
    }
    made = small_policy(generator=generator)
    made.check_sampling(10, 1.0, "held")
    made.check_sampling(5, 1.0, "rolled")
    for noise in ("rolled", "zero"):
        with pytest.raises(UserError, match=rf"^noise must be fresh or held with nfe=10, found {noise}"):
            made.check_sampling(10, 1.0, noise)


def test_rows_have_jumps_where_something_is_unusual_alone(tmp_path):
    usual = Protocol("fake", "default", 20, "0", 1, 0, 1.0, 0, 1, None, "cpu")
    (plain,) = roll_out(Job(build_fakes, tmp_path, usual), [3])
    assert "chunk_jump" not in plain
    for change in ({"noise": "held"}, {"candidates": 3}, {"clock": "running"}):
        (row,) = roll_out(Job(build_fakes, tmp_path, replace(usual, **change)), [3])
        assert row["chunk_jump"] > 0
    assert replace(usual, noise="rolled", candidates=1).name(20) == "seeds0-0_nfe1_rolled"
    assert replace(usual, candidates=8).name(20) == "seeds0-0_nfe1_best8"
