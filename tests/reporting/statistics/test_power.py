"""Which differences so many pairs show: by simulation, by closed forms, and where none is shown."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting.statistics.power import (
    detectable_difference,
    detectable_share_difference,
    mcnemar_power,
)
from imfvla.reporting.statistics.significance import mcnemar


@pytest.mark.parametrize(("pairs", "disagreement"), [(20, 0.5), (100, 0.5), (100, 0.15), (1000, 0.3)])
def test_the_detectable_difference_is_found_four_times_of_five(pairs, disagreement):
    found = detectable_share_difference(pairs, disagreement)
    assert mcnemar_power(pairs, max(disagreement, found), found) == pytest.approx(0.8, abs=1e-4)


def test_the_power_is_that_of_the_test_by_simulation():
    rng, number = np.random.default_rng(0), 1500
    counts = rng.multinomial(60, [0.3, 0.05, 0.65], number)  # ours alone, theirs alone, alike
    cache = dict.fromkeys(map(tuple, counts[:, :2].tolist()))
    for ours, theirs in cache:
        succeeded = np.repeat([True, False], [ours, theirs])
        cache[ours, theirs] = mcnemar(succeeded, ~succeeded) <= 0.05
    simulated = np.mean([cache[tuple(pair)] for pair in counts[:, :2].tolist()])
    power = mcnemar_power(60, 0.35, 0.25)
    assert power == pytest.approx(simulated, abs=4 * np.sqrt(power * (1 - power) / number))


@pytest.mark.parametrize("disagreement", [0.1, 0.3, 0.5])
def test_many_pairs_come_near_to_connor_s_formula(disagreement):
    pairs = 2000
    found = detectable_share_difference(pairs, disagreement)
    spread = 1.959964 * disagreement**0.5 + 0.841621 * (disagreement - found**2) ** 0.5
    assert found == pytest.approx(spread / pairs**0.5, rel=0.05)


def test_a_false_alarm_is_at_most_as_likely_as_it_may_be():
    assert all(mcnemar_power(pairs, 0.4, 0.0) <= 0.05 for pairs in (5, 20, 100, 400))


def test_few_pairs_show_nothing():
    assert detectable_share_difference(5) is None
    assert 0.9 < detectable_share_difference(6) <= 1.0


def test_where_all_pairs_agreed_a_difference_brings_its_own_disagreement():
    found = detectable_share_difference(100, 0.0)
    at_least_six = stats.binom.sf(5, 100, found)  # one-sided disagreements, the fewest that are significant
    assert at_least_six == pytest.approx(0.8, abs=1e-3)


def test_a_difference_of_means_by_hand():
    assert detectable_difference(2.0) == pytest.approx(2 * (1.959964 + 0.841621), rel=1e-5)
    assert detectable_difference(1.0, 4) == pytest.approx(2.776445 + 0.940965, rel=1e-5)
