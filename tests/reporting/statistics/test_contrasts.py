"""Differences and ratios of two policies, by hand and by what they must not depend on."""

import numpy as np
import pytest
from synthetic_runs import make_run, write_evaluation

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.episodes import read_episodes
from imfvla.reporting.metrics import summarise
from imfvla.reporting.runs import evaluations
from imfvla.reporting.statistics import estimates
from imfvla.reporting.statistics.contrasts import return_difference, return_ratio, speedup, success_difference
from imfvla.reporting.statistics.pairs import Pairs
from imfvla.reporting.statistics.significance import mcnemar, sign_flip
from imfvla.storage.run_directory import RunDirectory


@pytest.fixture
def policy(tmp_path):
    """Makes a policy's evaluations, one for each training seed."""

    def make(name: str, qualities=(0.6,), **options) -> list[Evaluated]:
        made = []
        for seed, quality in enumerate(qualities):
            run = tmp_path / name / f"seed={seed}"
            options = {"number": 40, "weights": f"{name}{seed}"} | options
            folder = write_evaluation(make_run(run, name, seed=seed), 1, quality=quality, **options)
            (found,) = evaluations(RunDirectory(run))
            made.append(Evaluated(found, read_episodes(folder / "episodes.jsonl", found.seeds)))
        return made

    return make


def column(evaluated: Evaluated, key: str) -> np.ndarray:
    return np.array([row[key] for row in evaluated.episodes], float)


def test_differences_of_one_training_each(policy):
    ours, theirs = policy("ours", (0.8,), stream=1), policy("theirs", (0.6,), stream=2)
    returns = [column(found, "total_reward") for (found,) in (ours, theirs)]
    successes = [column(found, "success") for (found,) in (ours, theirs)]

    found = success_difference(Pairs(ours, theirs))
    assert found.result == estimates.share_difference(*successes)
    assert (found.p, found.test) == (mcnemar(*successes), "exact McNemar")
    assert 0.1 < found.detectable < 0.5

    found = return_difference(Pairs(ours, theirs))
    assert found.result.value == pytest.approx(returns[0].mean() - returns[1].mean())
    alone = estimates.mean(returns[0] - returns[1])
    assert (found.result.low, found.result.high) == pytest.approx((alone.low, alone.high))
    assert (found.p, found.test) == (sign_flip(returns[0] - returns[1]), "sign flip")

    ratio = return_ratio(Pairs(ours, theirs))
    assert ratio.result.value == pytest.approx(returns[0].mean() / returns[1].mean())
    assert ratio.p == found.p
    assert ratio.detectable > 1


def test_ratios_turn_with_the_policies(policy):
    ours, theirs = policy("ours", (0.8,), latency_ms=2.0), policy("theirs", (0.6,), latency_ms=50.0, stream=3)
    for ratio in (return_ratio, speedup):
        found, turned = ratio(Pairs(ours, theirs)), ratio(Pairs(theirs, ours))
        assert turned.result.value == pytest.approx(1 / found.result.value)
        assert (turned.result.low, turned.result.high) == pytest.approx(
            (1 / found.result.high, 1 / found.result.low), rel=0.02
        )
        assert turned.p == pytest.approx(found.p)


def test_a_speedup_is_the_ratio_of_the_printed_latencies(policy):
    ours, theirs = policy("ours", latency_ms=2.0), policy("theirs", latency_ms=50.0, stream=3)
    means = [summarise(found.episodes)["inference_ms_mean"] for (found,) in (ours, theirs)]
    found = speedup(Pairs(ours, theirs))
    assert found.result.value == pytest.approx(means[1] / means[0])
    assert 24 < found.result.low < 25 < found.result.high < 26
    assert found.p < 1e-4


def test_a_policy_is_no_better_than_itself(policy):
    (ours,) = policy("ours")
    pairs = Pairs([ours], [ours])
    for contrast, alike in ((success_difference, 0), (return_difference, 0), (return_ratio, 1), (speedup, 1)):
        found = contrast(pairs)
        assert (found.result.value, found.p) == (pytest.approx(alike), 1.0)
        assert found.result.low <= alike <= found.result.high


def test_nothing_against_nothing_has_no_ratio(policy):
    ours, theirs = policy("ours", (-9.0,)), policy("theirs", (-9.0,))
    found = return_ratio(Pairs(ours, theirs))
    assert (found.result.value, found.result.high, found.p) == (None, None, 1.0)
    found = return_ratio(Pairs(policy("better"), theirs))
    assert (found.result.value, found.result.high) == (np.inf, None)


def test_without_times_there_is_no_speedup(policy):
    (ours,) = policy("ours")
    untimed = tuple(row | {"timing": {"wall_s": 1.0, "inference_ms": []}} for row in ours.episodes)
    found = speedup(Pairs([ours], [Evaluated(ours.evaluation, untimed)]))
    assert (found.result.value, found.p) == (None, None)


def test_training_seeds_that_disagree_make_a_difference_less_sure(policy):
    theirs = policy("theirs", (0.5,), stream=9)
    steady, unsteady = policy("steady", (0.7, 0.7, 0.7)), policy("unsteady", (0.35, 0.75, 1.2))
    for contrast in (success_difference, return_difference, return_ratio):
        sure, unsure = contrast(Pairs(steady, theirs)), contrast(Pairs(unsteady, theirs))
        assert sure.test == unsure.test == "sign flip, and t over training seeds"
        assert sure.p < 0.05 < unsure.p
        assert unsure.result.low < sure.result.low < sure.result.high < unsure.result.high
        assert sure.detectable < unsure.detectable
