"""Tests of pairs against closed forms and scipy, and Holm's correction against R."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting.statistics import significance
from imfvla.reporting.statistics.significance import holm, mcnemar, sign_flip, signed_rank


def outcomes(only_ours: int, only_theirs: int, both: int = 5) -> tuple[np.ndarray, np.ndarray]:
    counts = (only_ours, only_theirs, both)
    return np.repeat([1, 0, 1], counts), np.repeat([0, 1, 1], counts)


@pytest.mark.parametrize(
    ("only_ours", "only_theirs", "p"),
    [(8, 1, 20 / 512), (1, 8, 20 / 512), (5, 0, 1 / 16), (3, 3, 1), (0, 0, 1)],
)
def test_mcnemar_by_hand(only_ours, only_theirs, p):
    assert mcnemar(*outcomes(only_ours, only_theirs)) == pytest.approx(p)


@pytest.mark.parametrize("number", [2, 7, 11])
def test_few_sign_flips_are_all_tried(number):
    differences = np.random.default_rng(number).normal(0.5, 1, number)
    reference = stats.permutation_test(
        (differences, np.zeros(number)), lambda a, b, axis: (a - b).mean(axis=axis), permutation_type="samples",
        vectorized=True, n_resamples=np.inf,
    )  # fmt: skip
    assert sign_flip(differences) == pytest.approx(reference.pvalue)
    assert sign_flip(-differences) == sign_flip(differences)


def test_pairs_without_difference_change_no_sign_flip():
    differences = np.array([3.0, 1.0, -2.0, 4.0])
    assert sign_flip(np.concatenate([differences, np.zeros(500)])) == sign_flip(differences)
    assert sign_flip(np.zeros(10)) == 1.0
    assert sign_flip([]) == 1.0


def test_sums_that_are_equal_but_for_rounding_are_equal():
    assert sign_flip([0.1, 0.2, 0.3]) == 2 / 8
    assert sign_flip([0.3, -0.1, -0.2]) == 1.0


def test_many_sign_flips_are_drawn(monkeypatch):
    differences = np.random.default_rng(1).normal(0.4, 1, 16)
    exact = sign_flip(differences)
    monkeypatch.setattr(significance, "MOST_EXACT", 4)
    assert sign_flip(differences) == pytest.approx(exact, abs=4 * np.sqrt(exact / significance.FLIPS))
    assert sign_flip(np.full(60, 2.0)) == 1 / (significance.FLIPS + 1)


def test_many_sign_flips_against_the_normal_law():
    differences = np.random.default_rng(2).normal(0.15, 1, 200)
    score = differences.sum() / np.sqrt((differences**2).sum())
    assert sign_flip(differences) == pytest.approx(2 * stats.norm.sf(abs(score)), rel=0.05)


@pytest.mark.parametrize("number", [17, 20, 21])
def test_signs_of_eight_pairs_at_once_are_signs_of_pairs(monkeypatch, number):
    monkeypatch.setattr(significance, "MOST_KEPT", 16)
    differences = np.random.default_rng(number).normal(0.4, 1, number)
    found = sign_flip(differences)
    monkeypatch.undo()
    monkeypatch.setattr(significance, "MOST_EXACT", number)
    exact = sign_flip(differences)
    assert found == pytest.approx(exact, abs=4 * np.sqrt(exact / significance.FLIPS))


def test_holm_against_r():
    p = [0.01, 0.04, 0.03, 0.005]  # p.adjust(p, "holm") in R 4.4
    assert holm(p) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]


def test_holm_counts_only_what_was_tested():
    assert holm([None, 0.02, None, 0.03]) == [None, 0.04, None, 0.04]
    assert holm([None]) == [None]


def test_signed_ranks_by_hand():
    assert signed_rank([1.0, 2.0, 3.0]) == 2 / 8
    assert signed_rank([-1.0, 2.0, 30.0]) == 4 / 8  # rank sums 0, 1, 5 and 6 of the 8 are as far from 3
    assert signed_rank([0.0, 0.0, 1.0]) == signed_rank([5.0]) == 1.0
    assert signed_rank([]) == 1.0


@pytest.mark.parametrize("number", [3, 8, 15])
def test_signed_ranks_are_those_of_scipy(number):
    differences = np.random.default_rng(number).normal(0.3, 1, number)
    assert signed_rank(differences) == pytest.approx(stats.wilcoxon(differences, method="exact").pvalue)


def test_ties_share_the_mean_of_their_ranks():
    differences = np.array([1, 1, -1, 2, 2, 3, 0, 0, -3, 4], float)
    kept = differences[differences != 0]
    ranks = np.array([2, 2, 2, 4.5, 4.5, 6.5, 6.5, 8])
    signs = 2 * (np.arange(2**8)[:, None] >> np.arange(8) & 1) - 1
    observed = abs(np.sign(kept) @ ranks)
    assert signed_rank(differences) == np.mean(np.abs(signs @ ranks) >= observed)


def test_where_most_pairs_gain_a_little_and_some_lose_much_only_ranks_differ():
    """So that p by ranks would not belong to a mean, which is what the tables print."""
    differences = np.array([10.0] * 90 + [-90.0] * 10)
    assert sign_flip(differences) > 0.9
    assert signed_rank(differences) < 0.001
