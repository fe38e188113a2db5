"""Bootstrap intervals: against R and scipy, closed forms, and samples on which the method has no answer of its own."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting.statistics import bootstrap as module
from imfvla.reporting.statistics import resampling
from imfvla.reporting.statistics.bootstrap import Bootstrapped, bootstrap
from imfvla.reporting.statistics.estimates import INTERQUARTILE_MEAN, MEAN, MEDIAN
from imfvla.reporting.statistics.resampling import OfMeans

SKEWED = np.array([10, 12, 12.5, 12.5, 13.9, 15, 21, 22, 23, 34, 50, 81, 89, 121, 134, 213])


LOG_RATIO = OfMeans(lambda ours, theirs: np.log(ours) - np.log(theirs))
DIFFERENCE = OfMeans(np.subtract)
DIRECTLY = {  # each resample laid out, as others do it
    MEAN: np.mean,
    MEDIAN: np.median,
    INTERQUARTILE_MEAN: lambda values, axis: quarters_cut(np.sort(values, axis=axis)).mean(axis=axis),
}


def quarters_cut(ordered):
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut]


def log_ratio(ours, theirs, axis):
    return np.log(ours.mean(axis=axis)) - np.log(theirs.mean(axis=axis))


def test_a_skewed_mean_against_r(monkeypatch):
    monkeypatch.setattr(module, "RESAMPLES", 200_000)
    # R's boot, from scipy's tests: boot.ci(boot(x, mean, 1e6), type = "bca")
    found = bootstrap(MEAN, SKEWED)
    assert (found.low, found.high) == pytest.approx((32.31, 91.43), rel=0.005)
    assert found.error == pytest.approx(SKEWED.std() / 4, rel=0.02)


def test_many_normal_numbers_against_the_closed_form():
    values = np.random.default_rng(3).normal(50, 4, 400)
    found = bootstrap(MEAN, values)
    half = 1.96 * values.std() / 20
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half), abs=0.05 * half)


def test_paired_columns_against_scipy():
    rng = np.random.default_rng(4)
    theirs = rng.gamma(2, size=60)
    ours = 1.5 * theirs + rng.gamma(1, size=60)
    found = bootstrap(LOG_RATIO, ours, theirs)
    reference = stats.bootstrap(
        (ours, theirs), log_ratio, paired=True, n_resamples=10_000, rng=np.random.default_rng(0)
    )
    assert [found.low, found.high] == pytest.approx(list(reference.confidence_interval), rel=1e-9)
    assert found.exponential.low == pytest.approx(np.exp(found.low))
    unpaired = bootstrap(LOG_RATIO, ours, rng.permutation(theirs))
    assert found.high - found.low < 0.7 * (unpaired.high - unpaired.low)


def test_equal_calls_give_equal_intervals():
    assert bootstrap(MEDIAN, SKEWED) == bootstrap(MEDIAN, SKEWED)


def test_equal_numbers_give_a_point():
    assert bootstrap(MEAN, np.full(9, 2.5)) == Bootstrapped(2.5, 2.5, 2.5, 0.0)
    assert bootstrap(MEAN, np.full((3, 9), 2.5)) == Bootstrapped(2.5, 2.5, 2.5, 0.0)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_few_starts_have_no_interval_even_of_equal_numbers(number):
    assert bootstrap(MEAN, np.full(number, 7.0)) == Bootstrapped(7.0)
    assert bootstrap(MEAN, np.full((3, number), 7.0)) == Bootstrapped(7.0)
    assert bootstrap(MEAN, np.arange(float(number))).low is None


def test_the_fewest_starts_are_those_whose_range_can_hold_the_middle():
    assert module.TAILS[1] - module.TAILS[0] <= 1 - 2.0 ** (1 - module.FEWEST_STARTS)
    assert module.TAILS[1] - module.TAILS[0] > 1 - 2.0 ** (2 - module.FEWEST_STARTS)
    assert bootstrap(MEAN, np.arange(float(module.FEWEST_STARTS))).low is not None


@pytest.mark.parametrize("rewarded", [1, 20, 40])
def test_a_median_that_no_single_episode_moves(rewarded):
    values = np.where(np.arange(100) < rewarded, 900.0, 0.0)
    found = bootstrap(MEDIAN, values)
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high in (0.0, 450.0, 900.0)


def test_a_ratio_to_hardly_anything_has_no_upper_end():
    ours, theirs = np.full(30, 5.0), np.where(np.arange(30) == 0, 5.0, 0.0)
    ratio = bootstrap(LOG_RATIO, ours, theirs).exponential
    assert ratio.value == pytest.approx(30)
    assert 5 < ratio.low < 30
    assert ratio.high == np.inf
    assert bootstrap(LOG_RATIO, ours, np.zeros(30)).exponential.value == np.inf
    assert bootstrap(LOG_RATIO, np.zeros(30), np.zeros(30)).exponential.value is None


def test_columns_of_different_starts_are_refused():
    with pytest.raises(ValueError, match="have the same starts"):
        bootstrap(MEAN, np.zeros(3), np.zeros(4))


def test_training_seeds_that_differ_alone_give_student_s_interval():
    quality = np.array([3.0, 5.0, 4.0, 8.0, 6.0])
    found = bootstrap(MEAN, np.repeat(quality[:, None], 40, axis=1))
    assert found.error == pytest.approx(quality.std(ddof=1) / np.sqrt(5), rel=0.02)
    assert found.freedom == pytest.approx(4, rel=0.1)
    half = stats.t.ppf(0.975, 4) * found.error
    assert (found.value - found.low, found.high - found.value) == pytest.approx((half, half), rel=0.2)


def test_training_seeds_that_do_not_differ_leave_the_starts():
    values = np.random.default_rng(5).normal(10, 3, 50)
    once, thrice = bootstrap(MEAN, values), bootstrap(MEAN, np.tile(values, (3, 1)))
    assert thrice.freedom == pytest.approx(49, rel=0.1)
    assert (thrice.low, thrice.high) == pytest.approx((once.low, once.high), rel=0.01)


def test_training_seeds_of_two_policies_add_their_variances():
    ours, theirs = np.array([1.0, 3.0, 2.0]), np.array([7.0, 2.0])
    columns = [np.repeat(quality[:, None], 20, axis=1) for quality in (ours, theirs)]
    found = bootstrap(DIFFERENCE, *columns)
    parts = [ours.var(ddof=1) / 3, theirs.var(ddof=1) / 2]
    assert found.error == pytest.approx(np.sqrt(sum(parts)), rel=0.02)
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 2 + parts[1] ** 2)  # Welch and Satterthwaite
    assert found.freedom == pytest.approx(freedom, rel=0.05)


def test_columns_of_one_policy_share_its_training_seeds():
    column = np.random.default_rng(6).normal(size=(4, 1)) + np.zeros((4, 10))
    assert bootstrap(DIFFERENCE, (column, column + 1)).error == pytest.approx(0, abs=1e-12)
    assert bootstrap(DIFFERENCE, column, column + 1).error > 0.1


def test_resamples_in_parts_are_as_good(monkeypatch):
    values = np.random.default_rng(7).normal(size=(3, 1)) + np.random.default_rng(8).normal(size=(3, 20))
    whole = bootstrap(MEAN, values)
    for cache in (module._found, resampling.of_starts_and_seeds):
        cache.cache_clear()
    monkeypatch.setattr(resampling, "NUMBERS_AT_ONCE", 7000)
    found = bootstrap(MEAN, values)
    for cache in (module._found, resampling.of_starts_and_seeds):
        cache.cache_clear()
    assert found != whole  # as every part draws its own
    assert (found.low, found.high) == pytest.approx((whole.low, whole.high), abs=0.2 * whole.error)
    assert found.error == pytest.approx(whole.error, rel=0.03)


@pytest.mark.parametrize("number", [16, 101, 300])
@pytest.mark.parametrize("statistic", DIRECTLY)
def test_counts_give_the_interval_of_scipy_which_lays_out_every_resample(statistic, number):
    values = np.random.default_rng(number).gamma(2, size=number)
    reference = stats.bootstrap(
        (values,), DIRECTLY[statistic], n_resamples=10_000, rng=np.random.default_rng(0)
    )
    found = bootstrap(statistic, values)
    assert found.error == pytest.approx(reference.standard_error, rel=1e-9)
    # resamples that are equal to the value differ from it in rounding, here and there another way
    assert [found.low, found.high] == pytest.approx(list(reference.confidence_interval), rel=1e-3)


@pytest.mark.parametrize("statistic", [MEAN, INTERQUARTILE_MEAN])
@pytest.mark.parametrize("number", [16, 101, 300])
def test_intervals_of_whole_numbers_are_those_of_scipy(statistic, number):
    values = np.random.default_rng(number).integers(0, 40, number)
    reference = stats.bootstrap(
        (values,), DIRECTLY[statistic], n_resamples=10_000, rng=np.random.default_rng(0)
    )
    found = bootstrap(statistic, values)
    assert [found.low, found.high] == pytest.approx(list(reference.confidence_interval), rel=1e-12)


@pytest.mark.parametrize("statistic", DIRECTLY)
def test_counts_of_starts_and_seeds_are_those_of_what_was_drawn(statistic):
    """The numbers of every resample, laid out: each drawn seed at each drawn start."""
    values = np.random.default_rng(9).integers(0, 40, (3, 25)) + np.array([[0], [3], [9]])
    rng, direct = np.random.default_rng(0), DIRECTLY[statistic]
    places, seeds = rng.integers(0, 25, (10_000, 25)), rng.integers(0, 3, (10_000, 2))
    both = direct(values[seeds[:, :, None], places[:, None, :]].reshape(10_000, -1), axis=1)
    places = rng.integers(0, 25, (2_000, 25))
    of_starts = direct(values[:, places].transpose(1, 0, 2).reshape(2_000, -1), axis=1)
    of_seeds = direct(values[rng.integers(0, 3, (2_000, 2))].reshape(2_000, -1), axis=1)
    found = bootstrap(statistic, values)
    assert found.error == pytest.approx(np.std(both), rel=1e-12)
    freedom = np.var(both) ** 2 / (np.var(of_starts) ** 2 / 24 + np.var(of_seeds) ** 2 / 2)
    assert found.freedom == pytest.approx(freedom, rel=1e-9)


def test_many_numbers_are_counted_without_overflow():
    values = np.zeros((2, 40_000))
    values[1, ::2] = 1.0
    assert MEDIAN([(values,)], resampling.once(40_000, [2])) == [0.0]
    assert MEDIAN([(1 - values,)], resampling.once(40_000, [2])) == [1.0]
    assert INTERQUARTILE_MEAN([(values,)], resampling.once(40_000, [2])) == [0.0]
    assert MEAN([(values,)], resampling.once(40_000, [2])) == [0.25]
