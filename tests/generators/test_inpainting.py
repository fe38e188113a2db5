"""Guided sampling: agreement with the conditional of Gaussian actions, and what weights and strength are."""

import math

import pytest
import torch
from closed_forms import CHANNELS, STEPS, Context, GaussianFlow
from torch import nn

from imfvla.generators import inpainting
from imfvla.generators.act import ActionChunking
from imfvla.generators.base import UniformTimes
from imfvla.generators.ddpm import DenoisingDiffusion
from imfvla.generators.flow import FlowMatching
from imfvla.generators.imf import ImprovedMeanFlow
from imfvla.generators.imle import ImplicitMaximumLikelihood
from imfvla.generators.inpainting import Inpaints, Target, soft_weights, strength
from imfvla.generators.meanflow import MeanFlow
from imfvla.generators.regression import Regression
from imfvla.generators.staged import StagedMeanFlow
from imfvla.generators.two_step import TwoStepRegression
from imfvla.nn.residual import AttentionResidual
from imfvla.nn.transformer import TransformerCore

LINEAR = {
    "times": UniformTimes(),
    "time_power": 2.0,
    "adaptive_power": 0.0,
    "adaptive_offset": 1e-3,
    "draws": 1,
    "clip": 50.0,
}
AVERAGE = LINEAR | {"boundary_share": 1.0}
COMPOUND = AVERAGE | {"compound_draws": 1}
VALUE = 1.5  # of the first action, which is decided


class CorrelatedDenoiser(nn.Module):
    """The clean action E[x | z] of two unit Gaussians with a correlation, of the path z = signal x + spread e."""

    def __init__(self, correlation, levels=None):
        super().__init__()
        self.covariance = torch.tensor([[1, correlation], [correlation, 1]], dtype=torch.float64)
        self.levels = levels

    def forward(self, z, t, r, context):
        t = float(t[0])
        kept = None if self.levels is None else self.levels[round(t * len(self.levels)) - 1]
        signal, spread = (1 - t, t) if kept is None else (kept**0.5, (1 - kept) ** 0.5)
        noisy = signal**2 * self.covariance + spread**2 * torch.eye(2, dtype=torch.float64)
        return signal * self.covariance @ torch.linalg.solve(noisy, z)


def flow(parametrisation="data"):
    return FlowMatching(parametrisation=parametrisation, **LINEAR)


def improved():
    options = {"v_from": "boundary", "instant_weight": 1.0, "compound_target": "sample"}
    return ImprovedMeanFlow(parametrisation="velocity", **options, **COMPOUND)


def mean_flow():
    return MeanFlow(parametrisation="velocity", **COMPOUND)


def staged():
    stages = {"average_from": 0.5, "path_steps": 2, "velocity_head": True}
    return StagedMeanFlow(parametrisation="data", **stages, **AVERAGE)


def diffusion():
    return DenoisingDiffusion(num_levels=100, prediction="sample", clip_sample=False, draws=1, clip=50.0)


def inpaint(generator, correlation, nfe, count=2000):
    noise = torch.randn(count, 2, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    core = CorrelatedDenoiser(correlation, getattr(generator, "kept", None))
    values = torch.tensor([[VALUE], [0.0]], dtype=torch.float64).expand_as(noise)
    found = generator.inpaint(core, None, noise, nfe, Target(values, torch.tensor([1.0, 0.0])))
    with torch.no_grad():
        return found.squeeze(-1), generator.sample(core, None, noise, nfe).squeeze(-1)


@pytest.mark.parametrize(("make_one", "nfe"), [(flow, 60), (diffusion, 60), (diffusion, 100)])
def test_the_rest_is_drawn_as_the_conditional_says(make_one, nfe, monkeypatch):
    monkeypatch.setattr(inpainting, "STRONGEST", 1e9)
    (decided, rest), (_, free) = (chunks.T for chunks in inpaint(make_one(), 0.8, nfe))
    assert (decided - VALUE).abs().max() < 2e-3
    assert float(rest.mean()) == pytest.approx(
        0.8 * VALUE, abs=0.12
    )  # the guidance takes the variances as equal
    assert float(rest.std()) == pytest.approx(0.6, abs=0.03)
    assert abs(float(free.mean())) < 0.05
    assert float(free.std()) > 0.9


@pytest.mark.parametrize(("make_one", "nfe"), [(flow, 3), (flow, 10), (diffusion, 10)])
def test_of_independent_actions_the_decided_one_is_hit_and_the_rest_is_as_without(make_one, nfe):
    found, free = inpaint(make_one(), 0.0, nfe, count=50)
    assert (found[:, 0] - VALUE).abs().max() < (free[:, 0] - VALUE).abs().max() / 3
    torch.testing.assert_close(found[:, 1], free[:, 1])


def test_a_stronger_guidance_than_the_bound_is_not_taken(monkeypatch):
    bounded, _ = inpaint(flow(), 0.0, 40, count=50)
    monkeypatch.setattr(inpainting, "STRONGEST", 1e9)
    free, _ = inpaint(flow(), 0.0, 40, count=50)
    assert 1e-2 < (bounded[:, 0] - VALUE).abs().max() < 0.5
    assert (free[:, 0] - VALUE).abs().max() < 1e-4


@pytest.mark.parametrize("nfe", [2, 5])
@pytest.mark.parametrize("make_one", [lambda: flow("velocity"), improved, mean_flow])
def test_without_weights_a_chunk_is_that_of_the_flow(make_one, nfe):
    """Also with an average velocity, which a sample follows without a target."""
    noise = torch.randn(4, STEPS, CHANNELS, dtype=torch.float64)
    target = Target(torch.ones_like(noise), torch.zeros(STEPS))
    found = make_one().inpaint(GaussianFlow(), Context(), noise, nfe, target)
    torch.testing.assert_close(found, flow("velocity").sample(GaussianFlow(), Context(), noise, nfe))


def test_two_stages_are_guided_along_the_instantaneous_velocity():
    torch.manual_seed(0)
    core = TransformerCore(
        steps=4, channels=2, width=8, depth=1, heads=2, patch=2, mlp_ratio=2.0, max_rad=10.0,
        residual=lambda sublayers, width: AttentionResidual(sublayers, width, readout="sum"), velocity_head=True,
    )  # fmt: skip
    for stack in (core, core.average):
        nn.init.normal_(stack.output.weight, std=0.3)
    generator, noise = staged(), torch.randn(3, 4, 2)
    context = core.condition(torch.randn(3, 2, 8))
    with torch.no_grad():
        same = generator.inpaint(core, context, noise, 2, Target(noise, torch.zeros(4)))
        torch.testing.assert_close(same, generator.sample(core, context, noise, 2))
        values = torch.ones(3, 4, 2)
        near = generator.inpaint(core, context, noise, 2, Target(values, torch.ones(4)))
    assert (near - values).square().sum() < (same - values).square().sum()
    assert not near.requires_grad


def test_generators_that_sample_in_steps_can_be_guided_and_no_others():
    steps = FlowMatching, ImprovedMeanFlow, MeanFlow, StagedMeanFlow, DenoisingDiffusion
    assert all(issubclass(kind, Inpaints) for kind in steps)
    others = Regression, TwoStepRegression, ImplicitMaximumLikelihood, ActionChunking
    assert not any(issubclass(kind, Inpaints) for kind in others)


def test_weights_are_one_for_the_decided_and_fall_exponentially_over_the_rest():
    weights = soft_weights(8, decided=2, covered=5)
    falling = [(5 - i) / 4 for i in (2, 3, 4)]
    expected = [c * (math.exp(c) - 1) / (math.e - 1) for c in falling]
    torch.testing.assert_close(weights, torch.tensor([1, 1, *expected, 0, 0, 0]))
    assert torch.equal(soft_weights(4, decided=4, covered=4), torch.ones(4))
    assert torch.equal(soft_weights(3, decided=0, covered=0), torch.zeros(3))


def test_the_strength_is_bounded_at_noise_and_at_data():
    assert strength(1.0) == strength(0.0) == strength(0.99) == strength(0.01) == 5
    assert strength(0.5) == pytest.approx(2)
    assert strength(0.3) == pytest.approx((0.49 + 0.09) / 0.21)
