"""Nominal 95% intervals hold the truth in 93 to 97 of 100 samples: of 2,000 each, with fewer resamples for speed."""

import numpy as np
import pytest

from imfvla.reporting.statistics import bootstrap, estimates

DRAWS, EPISODES = 2000, 100


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture
def few_resamples(monkeypatch):
    monkeypatch.setattr(bootstrap, "RESAMPLES", 500)


def coverage(sample, truth: float, draws: int = DRAWS) -> float:
    found = [sample() for _ in range(draws)]
    return np.mean([estimate.low <= truth <= estimate.high for estimate in found])


@pytest.mark.parametrize("share", [0.05, 0.29, 0.44, 0.9])
def test_wilson(rng, share):
    assert 0.93 <= coverage(lambda: estimates.share(rng.random(EPISODES) < share), share) <= 0.97


def test_bca_of_a_mean(rng, few_resamples):
    """Skewed, as returns are."""
    assert 0.93 <= coverage(lambda: estimates.mean(rng.gamma(4, size=EPISODES)), 4) <= 0.97


def test_bca_of_a_paired_difference(rng, few_resamples):
    def sample():
        start = rng.gamma(2, size=EPISODES)  # how hard it is, for both
        ours, theirs = 3 * start + rng.normal(size=EPISODES), 2 * start + rng.gamma(1, size=EPISODES)
        return bootstrap.bootstrap(estimates.MEAN, ours - theirs)

    assert 0.93 <= coverage(sample, 3 * 2 - 2 * 2 - 1) <= 0.97


@pytest.mark.parametrize(("ours", "theirs"), [(0.44, 0.29), (0.9, 0.8)])
def test_newcombe_s_paired_difference(rng, ours, theirs):
    def sample():
        luck = rng.random(EPISODES)
        other = np.where(rng.random(EPISODES) < 0.5, luck, rng.random(EPISODES))
        return estimates.share_difference(luck < ours, other < theirs)

    assert 0.93 <= coverage(sample, ours - theirs) <= 0.97


@pytest.mark.parametrize("seeds", [3, 5])
def test_several_training_seeds(rng, few_resamples, seeds):
    """Fewer samples, wider bounds: with so few seeds the interval is cautious rather than exact."""

    def sample():
        parts = rng.normal(0, 100, (seeds, 1)) + rng.normal(0, 200, EPISODES)
        return estimates.mean(1000 + parts + rng.normal(0, 300, (seeds, EPISODES)))

    assert 0.93 <= coverage(sample, 1000, draws=300) <= 0.995
