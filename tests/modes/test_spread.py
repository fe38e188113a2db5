"""Spread and jumps of chunks whose distribution is known."""

import numpy as np
import pytest

from imfvla.modes.spread import joints_of, measure_jumps, measure_spread
from imfvla.tasks.bimanual_robot import bimanual_robot

N, K, PRED, EXEC = 400, 8, 6, 4
SCALE = np.full((PRED, 16), 0.5)
JOINTS = joints_of(bimanual_robot((), (8, 8)))


def test_samples_from_the_demonstrations_distribution_spread_as_much_as_they_miss():
    rng = np.random.default_rng(0)
    centre = rng.normal(size=(N, 1, PRED, 16))  # what is seen says this much
    samples = centre + 0.3 * rng.normal(size=(N, K, PRED, 16))
    demonstrated = centre[:, 0] + 0.3 * rng.normal(size=(N, PRED, 16))
    assert measure_spread(samples, demonstrated, SCALE) == pytest.approx(
        {"spread": 0.6, "spread_ratio": 1.0}, rel=0.01
    )
    half = centre + 0.5 * (samples - centre)
    assert measure_spread(half, demonstrated, SCALE)["spread_ratio"] == pytest.approx(0.5, rel=0.02)


def test_a_policy_that_ignores_its_noise_has_no_spread():
    samples = np.zeros((3, K, PRED, 16))
    assert measure_spread(samples, np.ones((3, PRED, 16)), SCALE) == {"spread": 0.0, "spread_ratio": 0.0}
    assert measure_spread(samples, samples[:, 0], SCALE)["spread_ratio"] is None


def test_jumps_are_over_the_steps_that_both_chunks_have():
    steps = np.arange(PRED + EXEC)[:, None] * np.ones(16)
    chunks, later = steps[None, None, :PRED], steps[None, None, EXEC:]
    assert measure_jumps(chunks, later, EXEC, SCALE, JOINTS) == {"jump_rad": 0.0, "jump": 0.0}
    assert measure_jumps(chunks, later + 0.1, EXEC, SCALE, JOINTS) == pytest.approx(
        {"jump_rad": 0.1, "jump": 0.2}
    )
    grippers = later.copy()
    grippers[..., 7] += 1
    only_grippers = measure_jumps(chunks, grippers, EXEC, SCALE, JOINTS)
    assert only_grippers == pytest.approx({"jump_rad": 0.0, "jump": 0.5})


def test_chunks_without_common_steps_have_no_jump():
    chunks = np.zeros((1, 2, PRED, 16))
    assert measure_jumps(chunks, chunks, PRED, SCALE, JOINTS) == {"jump_rad": None, "jump": None}
