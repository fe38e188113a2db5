"""A number of a policy with its interval: closed forms, published values, and what several training seeds change."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting.statistics import estimates
from imfvla.reporting.statistics.estimates import wilson_interval
from imfvla.reporting.statistics.measured import Measured

VALUES = np.array([0.0, 0.0, 10.0, 40.0, 50.0, 70.0, 90.0, 2000.0])


def paired(both: int, ours: int, theirs: int, neither: int) -> tuple[np.ndarray, np.ndarray]:
    counts = (both, ours, theirs, neither)
    return np.repeat([True, True, False, False], counts), np.repeat([True, False, True, False], counts)


def test_the_three_middles_by_hand():
    assert estimates.mean(VALUES).value == 282.5
    assert estimates.median(VALUES).value == 45.0
    assert estimates.interquartile_mean(VALUES).value == 42.5
    for estimate in (estimates.mean, estimates.median, estimates.interquartile_mean):
        found = estimate(VALUES)
        assert VALUES.min() <= found.low < found.value < found.high <= VALUES.max()


def test_an_interval_of_rewards_is_never_negative():
    """Two trainings, one of which did nothing: the interval is stretched far, but not below what can be."""
    values = np.stack([np.full(20, 1000.0), np.zeros(20)])
    for estimate in (estimates.mean, estimates.median, estimates.interquartile_mean):
        assert estimate(values).low == 0
    assert estimates.mean(values - 1).low < 0
    for estimate in (estimates.mean, estimates.median, estimates.interquartile_mean):
        assert estimate(-values).high == 0


def test_a_pooled_mean_weighs_every_number_alike():
    totals, counts = np.tile([10.0, 30.0, 8.0, 0.0], 2), np.tile([2, 10, 2, 0], 2)
    found = estimates.pooled_mean(totals, counts)
    assert found.value == pytest.approx(48 / 14)
    assert 2.999 <= found.low < found.value < found.high <= 5.001
    assert estimates.pooled_mean(np.zeros(3), np.zeros(3)) == Measured(None)


def test_times_of_two_trainings_have_the_interval_of_their_episodes():
    """Student's t with one degree of freedom would stretch the difference of two machines' loads to 12.7 times."""
    rng = np.random.default_rng(1)
    counts = np.full(60, 20)
    times = [counts * (ms + rng.normal(0, 1, 60)) for ms in (40, 60, 50)]
    two, three = (estimates.pooled_mean(np.stack(times[:n]), np.stack([counts] * n)) for n in (2, 3))
    assert two.value == pytest.approx(50, rel=0.01)
    error = np.std(np.mean(times[:2], axis=0) / 20, ddof=1) / np.sqrt(60)
    assert (two.value - two.low, two.high - two.value) == pytest.approx((1.96 * error, 1.96 * error), rel=0.1)
    assert three.low < 40 < 60 < three.high


def test_a_share_has_wilson_s_interval():
    happened = np.arange(100) < 44
    assert estimates.share(happened) == Measured(0.44, *wilson_interval(44, 100))


def test_a_share_of_training_seeds_is_as_sure_as_they_agree():
    starts = np.arange(100)
    alike = np.stack([starts < 70, starts < 70, starts < 70])
    apart = np.stack([starts < 40, starts < 75, starts < 95])
    one = estimates.share(starts < 70)
    found = {name: estimates.share(seeds) for name, seeds in {"alike": alike, "apart": apart}.items()}
    assert (found["alike"].low, found["alike"].high) == pytest.approx((one.low, one.high), abs=0.01)
    assert found["apart"].high - found["apart"].low > 0.6
    everywhere = estimates.share(np.ones((3, 100)))
    assert (everywhere.low, everywhere.high) == pytest.approx(wilson_interval(100, 100))


# M. Fagerland et al., Statistical Analysis of Contingency Tables (2017), chapter 8
@pytest.mark.parametrize(
    ("table", "low", "high"),
    [((1, 1, 7, 12), -0.507, -0.026), ((59, 6, 16, 80), -0.1186, -0.0046)],
)
def test_a_paired_difference_of_shares_against_published_values(table, low, high):
    found = estimates.share_difference(*paired(*table))
    assert found.value == pytest.approx((table[1] - table[2]) / sum(table))
    assert (found.low, found.high) == pytest.approx((low, high), abs=6e-4)


def test_a_paired_difference_of_shares_mirrors_and_stays_possible():
    ours, theirs = paired(50, 30, 5, 15)
    found, mirrored = estimates.share_difference(ours, theirs), estimates.share_difference(theirs, ours)
    assert (mirrored.low, mirrored.high) == pytest.approx((-found.high, -found.low))
    whole = estimates.share_difference(*paired(0, 20, 0, 0))
    assert (whole.value, whole.high) == (1.0, pytest.approx(1.0))
    assert whole.low < 0.9


def test_two_policies_that_always_succeed_may_still_differ():
    found = estimates.share_difference(*paired(100, 0, 0, 0))
    lost = 1 - wilson_interval(100, 100)[0]
    assert (found.value, found.low, found.high) == pytest.approx((0, -lost, lost))


def test_the_interquartile_mean_is_scipy_s():
    values = np.random.default_rng(0).gamma(2, size=37)
    assert estimates.interquartile_mean(values).value == pytest.approx(
        stats.trim_mean(values, 0.25), rel=1e-12
    )
