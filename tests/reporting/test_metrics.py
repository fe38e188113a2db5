"""The nine metrics and the interval of a share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imfvla.episode import EpisodeResult
from imfvla.reporting.metrics import summarise
from imfvla.reporting.rows import row_of, untimed
from imfvla.reporting.statistics.estimates import wilson_interval


def result(seed: int, total: float, highest: float, **changes) -> EpisodeResult:
    defaults = {
        "seed": seed, "start_digest": "d", "num_steps": 700, "total_reward": total, "max_reward": highest,
        "success": highest > 4, "first_step_of_stage": (1, -1), "failure": None, "inference_ms": (2.0, 4.0),
        "wall_s": 3.5,
    }  # fmt: skip
    return EpisodeResult(**{**defaults, **changes})


def test_the_metrics_by_hand():
    rows = [
        row_of(result(0, 0.0, 0.0)),
        row_of(result(1, 100.0, 3.0, inference_ms=(2.0, 12.0))),
        row_of(result(2, 1400.0, 5.0)),
        row_of(result(3, 20.0, 1.0, failure="non-finite action", num_steps=350, wall_s=1.5, inference_ms=())),
    ]
    summary = summarise(rows)
    expected = {
        "episodes": 4,
        "avg_return": 380.0,
        "median_return": 60.0,
        "iqm_return": 60.0,
        "mean_max_reward": 2.25,
        "max_return": 1400.0,
        "nonzero_episodes": 3,
        "nonzero_share": 0.75,
        "success_episodes": 1,
        "success_share": 0.25,
        "inference_fps": pytest.approx(1000 * 6 / 26),
        "control_fps": pytest.approx((3 * 700 + 350) / 12),
        "inference_ms_mean": pytest.approx(26 / 6),
        "inference_ms_median": 3.0,
        "inference_ms_p95": pytest.approx(np.percentile([2, 4, 2, 12, 2, 4], 95)),
        "success_interval": list(wilson_interval(1, 4)),
        "failures": {"non-finite action": 1},
    }
    assert {key: summary[key] for key in expected} == expected


def test_an_evaluation_without_any_inference_has_no_latency():
    summary = summarise(
        [row_of(result(0, 0.0, 0.0, inference_ms=(), failure="action far out of range", num_steps=0))]
    )
    assert summary["inference_ms_mean"] is summary["inference_fps"] is None
    assert summary["control_fps"] == 0


def test_times_are_the_only_difference_of_equal_episodes():
    first, second = row_of(result(0, 1.0, 1.0)), row_of(result(0, 1.0, 1.0, wall_s=9.0, inference_ms=(1.0,)))
    assert first != second
    assert untimed(first) == untimed(second)
    assert list(first)[-1] == "timing"


# statsmodels.stats.proportion.proportion_confint(method="wilson")
@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.277533),
        (5, 100, 0.021543, 0.111752),
        (44, 100, 0.346737, 0.537719),
        (100, 100, 0.963006, 1.0),
    ],
)
def test_wilson_against_published_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=2e-5)


@given(st.integers(1, 2000).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials))))
def test_wilson_holds_the_share_and_mirrors(counts):
    successes, trials = counts
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    mirrored = wilson_interval(trials - successes, trials)
    assert (1 - high, 1 - low) == pytest.approx(mirrored, abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_what_is_no_share(successes, trials):
    with pytest.raises(ValueError, match="0 <= successes <= trials"):
        wilson_interval(successes, trials)


def test_successes_are_counted_by_goal_where_a_scene_serves_several_tasks():
    rows = [row_of(result(seed, 1.0, 5.0 * (seed < 3), goal=("a", "b")[seed % 2])) for seed in range(5)]
    assert summarise(rows)["success_of_goal"] == {"a": [2, 3], "b": [1, 2]}
