"""Bootstrap intervals: against R and scipy, closed forms, and samples on which the method has no answer of its own."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting import bootstrap as module
from imfvla.reporting.bootstrap import Bootstrapped, bootstrap
from imfvla.reporting.estimates import INTERQUARTILE_MEAN, MEAN, MEDIAN

SKEWED = np.array([10, 12, 12.5, 12.5, 13.9, 15, 21, 22, 23, 34, 50, 81, 89, 121, 134, 213])


def log_ratio(a, b, axis=-1):
    return np.log(a.mean(axis=axis)) - np.log(b.mean(axis=axis))


def test_a_skewed_mean_against_r(monkeypatch):
    monkeypatch.setattr(module, "RESAMPLES", 200_000)
    # R's boot, from scipy's tests: boot.ci(boot(x, mean, 1e6), type = "bca")
    found = bootstrap(np.mean, SKEWED)
    assert (found.low, found.high) == pytest.approx((32.31, 91.43), rel=0.005)
    assert found.error == pytest.approx(SKEWED.std() / 4, rel=0.02)


def test_many_normal_numbers_against_the_closed_form():
    values = np.random.default_rng(3).normal(50, 4, 400)
    found = bootstrap(np.mean, values)
    half = 1.96 * values.std() / 20
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half), abs=0.05 * half)


def test_paired_columns_against_scipy():
    rng = np.random.default_rng(4)
    theirs = rng.gamma(2, size=60)
    ours = 1.5 * theirs + rng.gamma(1, size=60)
    found = bootstrap(log_ratio, ours, theirs)
    reference = stats.bootstrap(
        (ours, theirs), log_ratio, paired=True, n_resamples=10_000, rng=np.random.default_rng(0)
    )
    assert [found.low, found.high] == pytest.approx(list(reference.confidence_interval), rel=1e-9)
    assert found.exponential.low == pytest.approx(np.exp(found.low))
    unpaired = bootstrap(log_ratio, ours, rng.permutation(theirs))
    assert found.high - found.low < 0.7 * (unpaired.high - unpaired.low)


def test_equal_calls_give_equal_intervals():
    assert bootstrap(np.median, SKEWED) == bootstrap(np.median, SKEWED)


def test_equal_numbers_give_a_point():
    assert bootstrap(np.mean, np.full(9, 2.5)) == Bootstrapped(2.5, 2.5, 2.5, 0.0)
    assert bootstrap(np.mean, np.full((3, 9), 2.5)) == Bootstrapped(2.5, 2.5, 2.5, 0.0)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_few_starts_have_no_interval_even_of_equal_numbers(number):
    assert bootstrap(np.mean, np.full(number, 7.0)) == Bootstrapped(7.0)
    assert bootstrap(np.mean, np.full((3, number), 7.0)) == Bootstrapped(7.0)
    assert bootstrap(np.mean, np.arange(float(number))).low is None


def test_the_fewest_starts_are_those_whose_range_can_hold_the_middle():
    assert module.TAILS[1] - module.TAILS[0] <= 1 - 2.0 ** (1 - module.FEWEST_STARTS)
    assert module.TAILS[1] - module.TAILS[0] > 1 - 2.0 ** (2 - module.FEWEST_STARTS)
    assert bootstrap(np.mean, np.arange(float(module.FEWEST_STARTS))).low is not None


@pytest.mark.parametrize("rewarded", [1, 20, 40])
def test_a_median_that_no_single_episode_moves(rewarded):
    values = np.where(np.arange(100) < rewarded, 900.0, 0.0)
    found = bootstrap(np.median, values)
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high in (0.0, 450.0, 900.0)


def test_a_ratio_to_hardly_anything_has_no_upper_end():
    ours, theirs = np.full(30, 5.0), np.where(np.arange(30) == 0, 5.0, 0.0)
    ratio = bootstrap(log_ratio, ours, theirs).exponential
    assert ratio.value == pytest.approx(30)
    assert 5 < ratio.low < 30
    assert ratio.high == np.inf
    assert bootstrap(log_ratio, ours, np.zeros(30)).exponential.value == np.inf
    assert bootstrap(log_ratio, np.zeros(30), np.zeros(30)).exponential.value is None


def test_columns_of_different_starts_are_refused():
    with pytest.raises(ValueError, match="have the same starts"):
        bootstrap(np.mean, np.zeros(3), np.zeros(4))


def test_training_seeds_that_differ_alone_give_student_s_interval():
    quality = np.array([3.0, 5.0, 4.0, 8.0, 6.0])
    found = bootstrap(np.mean, np.repeat(quality[:, None], 40, axis=1))
    assert found.error == pytest.approx(quality.std(ddof=1) / np.sqrt(5), rel=0.02)
    assert found.freedom == pytest.approx(4, rel=0.1)
    half = stats.t.ppf(0.975, 4) * found.error
    assert (found.value - found.low, found.high - found.value) == pytest.approx((half, half), rel=0.2)


def test_training_seeds_that_do_not_differ_leave_the_starts():
    values = np.random.default_rng(5).normal(10, 3, 50)
    once, thrice = bootstrap(np.mean, values), bootstrap(np.mean, np.tile(values, (3, 1)))
    assert thrice.freedom == pytest.approx(49, rel=0.1)
    assert (thrice.low, thrice.high) == pytest.approx((once.low, once.high), rel=0.01)


def test_training_seeds_of_two_policies_add_their_variances():
    ours, theirs = np.array([1.0, 3.0, 2.0]), np.array([7.0, 2.0])
    columns = [np.repeat(quality[:, None], 20, axis=1) for quality in (ours, theirs)]
    found = bootstrap(lambda a, b, axis: a.mean(axis=axis) - b.mean(axis=axis), *columns)
    parts = [ours.var(ddof=1) / 3, theirs.var(ddof=1) / 2]
    assert found.error == pytest.approx(np.sqrt(sum(parts)), rel=0.02)
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 2 + parts[1] ** 2)  # Welch and Satterthwaite
    assert found.freedom == pytest.approx(freedom, rel=0.05)


def test_columns_of_one_policy_share_its_training_seeds():
    column = np.random.default_rng(6).normal(size=(4, 1)) + np.zeros((4, 10))
    difference = lambda a, b, axis: a.mean(axis=axis) - b.mean(axis=axis)  # noqa: E731
    assert bootstrap(difference, (column, column + 1)).error == pytest.approx(0, abs=1e-12)
    assert bootstrap(difference, column, column + 1).error > 0.1


def test_a_hierarchical_bootstrap_in_blocks_is_the_same_bootstrap(monkeypatch):
    values = np.random.default_rng(7).normal(size=(3, 1)) + np.random.default_rng(8).normal(size=(3, 20))
    whole = bootstrap(np.mean, values)
    monkeypatch.setattr(module, "NUMBERS_AT_ONCE", 7000)
    assert bootstrap(np.mean, values).error == pytest.approx(whole.error, rel=0.03)


@pytest.mark.parametrize("number", [16, 101])
@pytest.mark.parametrize("statistic", [MEAN, MEDIAN, INTERQUARTILE_MEAN])
def test_counting_what_was_drawn_gives_the_same_numbers(statistic, number):
    values = np.random.default_rng(number).integers(0, 40, number)
    assert bootstrap(statistic, values) == bootstrap(statistic.of, values)


def test_numbers_that_are_not_whole_are_not_counted(monkeypatch):
    monkeypatch.setattr(module, "_counts", None)
    assert bootstrap(MEDIAN, SKEWED) == bootstrap(np.median, SKEWED)
