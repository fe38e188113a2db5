import math

import pytest
import torch

from imfvla.benchmarks.toy import (
    CASES,
    DEVIATION,
    GENERATORS,
    NUM_MODES,
    SCALE,
    centres,
    draw,
    energy_distance,
    judge,
    run_cases,
)


def stream(seed):
    return torch.Generator().manual_seed(seed)


def test_the_energy_distance_of_normals_is_the_closed_form():
    """In one dimension E|N(m, s^2)| is known; a second channel of zeros leaves distances as they are."""

    def expected(mean, deviation):
        tail = math.erf(mean / deviation / math.sqrt(2))
        return deviation * math.sqrt(2 / math.pi) * math.exp(-0.5 * (mean / deviation) ** 2) + mean * tail

    quantiles = torch.special.ndtri((torch.arange(1000) + 0.5) / 1000)
    x = torch.stack((quantiles, torch.zeros(1000)), dim=-1)
    y = x + torch.tensor([1.0, 0.0])
    wanted = 2 * expected(1.0, math.sqrt(2)) - 2 * expected(0.0, math.sqrt(2))
    assert energy_distance(x, y) == pytest.approx(wanted, abs=3e-3)


def test_data_pass_their_own_test():
    quality = judge(draw(4000, stream(0)), stream(1))
    assert quality.passes
    assert quality.energy_distance == pytest.approx(0, abs=2e-3)
    assert quality.near > 0.99


@pytest.mark.parametrize(
    "spoil",
    [
        lambda x: torch.zeros_like(x),  # their mean, what a regression gives
        lambda x: x * 0.93,
        lambda x: x[(x - centres()[2]).norm(dim=1) > 5 * SCALE * DEVIATION],  # a mode is missing
        lambda x: x + 0.2 * torch.randn(x.shape, generator=stream(3)),
    ],
)
def test_spoiled_data_fail(spoil):
    assert not judge(spoil(draw(4000, stream(0))), stream(1)).passes


def test_every_generator_is_trained_and_judged():
    steps = []
    cases = run_cases(steps=2, samples=50, seed=0, advance=lambda: steps.append(1))
    assert len(steps) == 2 * len(GENERATORS)
    assert [(case.generator, case.nfe, case.must_pass) for case in cases] == list(CASES)
    assert all(case.samples.shape == (50, 2) for case in cases)
    assert all(0 <= case.quality.modes <= NUM_MODES for case in cases)
