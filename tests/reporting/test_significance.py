"""Tests of pairs against closed forms and scipy, and Holm's correction against R."""

import numpy as np
import pytest
from scipy import stats

from imfvla.reporting import significance
from imfvla.reporting.significance import holm, mcnemar, sign_flip


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


def test_holm_against_r():
    p = [0.01, 0.04, 0.03, 0.005]  # p.adjust(p, "holm") in R 4.4
    assert holm(p) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]


def test_holm_counts_only_what_was_tested():
    assert holm([None, 0.02, None, 0.03]) == [None, 0.04, None, 0.04]
    assert holm([None]) == [None]
