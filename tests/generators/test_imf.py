"""Closed forms on Gaussian data N(m, diag s^2), where the marginal and the average velocity are known exactly."""

import pytest
import torch
from closed_forms import MEAN, STD, STEPS, Context, GaussianFlow, Recorded, columns, draw
from test_flow import generator as flow_generator
from test_meanflow import generator as meanflow_generator
from torch import nn

from imfvla.errors import UserError
from imfvla.generators.base import HighNoiseTimes, LogitNormalTimes, UniformTimes, masked_error
from imfvla.generators.imf import ImprovedMeanFlow
from imfvla.nn.forward_mode import jvp


def generator(**changes):
    options = {
        "parametrisation": "velocity",
        "times": UniformTimes(),
        "boundary_share": 0.0,
        "v_from": "boundary",
        "instant_weight": 0.0,
        "compound_target": "sample",
        "time_power": 0.0,
        "adaptive_power": 0.0,
        "adaptive_offset": 1e-3,
        "draws": 1,
        "compound_draws": 1,
        "clip": 1e6,
    }
    return ImprovedMeanFlow(**(options | changes))


def compound(sign=1.0):
    """V - v for the exact flow: zero where the identity (paper eq. 7) and its sign are right."""
    z, t, r = draw()
    flow, gen = GaussianFlow(), generator()
    v = flow(z, t, t, None)
    u, push = gen.linearise(flow, z, r, t, Context(), slice(None))
    dudt = push(v)
    (gap,) = columns(t - r)
    return (u + sign * gap * dudt - v).abs().max()


def test_the_compound_of_the_exact_average_velocity_is_the_instantaneous_one():
    assert compound() < 1e-10


def test_a_flipped_sign_breaks_the_identity():
    assert compound(sign=-1.0) > 0.1


@pytest.mark.parametrize("nfe", [1, 2, 3])
def test_any_number_of_exact_steps_maps_noise_to_data(nfe):
    noise, _, _ = draw()
    sample = generator().sample(GaussianFlow(), None, noise, nfe)
    torch.testing.assert_close(sample, MEAN + STD * noise, rtol=1e-10, atol=1e-10)


def test_average_velocities_compose():
    """(t - r) u(z, r, t) = (t - s) u(z, s, t) + (s - r) u(z_s, r, s)."""
    z, t, r = draw()
    flow, s = GaussianFlow(), (t + r) / 2
    t3, s3, r3 = columns(t, s, r)
    z_s = z - (t3 - s3) * flow(z, t, s, None)
    torch.testing.assert_close(
        (t3 - r3) * flow(z, t, r, None), (t3 - s3) * flow(z, t, s, None) + (s3 - r3) * flow(z_s, s, r, None)
    )


@pytest.mark.parametrize("nfe", [1, 2, 5])
def test_constant_data_is_reached_in_one_step_whatever_the_noise(nfe):
    class Constant(nn.Module):
        def forward(self, x, t, r, context):
            return MEAN.expand(len(x), -1, -1)

    noise, _, _ = draw()
    sample = generator(parametrisation="data").sample(Constant(), None, noise, nfe)
    torch.testing.assert_close(sample, MEAN.expand_as(sample), rtol=1e-5, atol=1e-5)


class PointFlow(nn.Module):
    """The exact average velocity of constant data, u(z, r, t) = (z - x) / t for every r."""

    def forward(self, z, t, r, context):
        return (z - MEAN) / t[:, None, None]


@pytest.mark.parametrize("make", [generator, meanflow_generator, flow_generator])
def test_on_constant_data_the_exact_velocity_has_no_loss_and_one_step_is_exact(make):
    gen = make(times=LogitNormalTimes(-0.4, 1.0))
    valid = torch.ones(64, STEPS, dtype=torch.bool)
    loss, _ = gen.loss(
        PointFlow(), Context(), MEAN.expand(64, -1, -1), valid, torch.Generator().manual_seed(0)
    )
    assert loss.max() < 1e-10
    noise, _, _ = draw()
    sample = gen.sample(PointFlow(), None, noise, 1)
    torch.testing.assert_close(sample, MEAN.expand_as(sample), rtol=1e-5, atol=1e-5)


def test_along_the_flow_of_constant_data_the_velocity_does_not_change():
    class Constant(nn.Module):
        def forward(self, x, t, r, context):
            return MEAN.expand(len(x), -1, -1) + 0 * x

    z, t, r = draw()
    gen = generator(parametrisation="data")
    v = gen.velocity(Constant(), z, t, t, None)
    _, push = gen.linearise(Constant(), z, r, t, Context(), slice(None))
    assert push(v).abs().max() < 1e-10


def test_both_parametrisations_name_the_same_velocity():
    z, t, r = draw()
    flow = GaussianFlow()

    class CleanAction(nn.Module):
        def forward(self, x, t, r, context):
            return x - t[:, None, None] * flow(x, t, r, context)

    torch.testing.assert_close(
        generator(parametrisation="data").velocity(CleanAction(), z, r, t, None), flow(z, t, r, None)
    )


def test_gradient_flows_through_the_primal_alone():
    core, gen = Recorded(), generator()
    actions = MEAN + STD * draw(8)[0]
    valid = torch.ones(8, STEPS, dtype=torch.bool)
    rng = torch.Generator().manual_seed(4)
    gen.loss(core, Context(), actions, valid, rng)[0].mean().backward()
    found = [p.grad.clone() for p in core.parameters()]

    rng = torch.Generator().manual_seed(4)
    noise = torch.randn(actions.shape, generator=rng).to(actions)
    r, t = (time.to(actions) for time in gen.intervals(8, rng))
    (t3, r3) = columns(t, r)
    z = (1 - t3) * actions + t3 * noise
    with torch.no_grad():
        v = core(z, t, t, None)
        _, dudt = jvp(lambda z, t: core(z, t, r, None), (z, t), (v, torch.ones_like(t)))
    expected = (core(z, t, r, None) + (t3 - r3) * dudt - (noise - actions)).square().mean()
    for gradient, wanted in zip(found, torch.autograd.grad(expected, list(core.parameters())), strict=True):
        torch.testing.assert_close(gradient, wanted)


@pytest.mark.parametrize("instant_weight", [0.0, 1.0])
def test_steps_that_are_not_valid_do_not_count(instant_weight):
    core, gen = Recorded(), generator(instant_weight=instant_weight)
    z, _, _ = draw(4)
    valid = torch.tensor([[True, True, False]]).expand(4, -1)
    error = torch.randn(z.shape, generator=torch.Generator().manual_seed(5), dtype=z.dtype)
    garbage = error.clone()
    garbage[:, 2] = 1e9
    torch.testing.assert_close(masked_error(garbage, valid), error[:, :2].square().mean((1, 2)))
    loss, _ = gen.loss(core, Context(), z, valid, torch.Generator().manual_seed(0))
    assert loss.shape == (4,)
    assert loss.isfinite().all()


def test_sampling_is_a_pure_function_of_its_noise():
    core, gen = Recorded(), generator()
    noise, _, _ = draw(4)
    assert torch.equal(gen.sample(core, None, noise, 2), gen.sample(core, None, noise, 2))


def test_the_final_sample_is_clamped():
    noise, _, _ = draw()
    assert generator(clip=0.5).sample(GaussianFlow(), None, noise, 1).abs().max() == 0.5


@pytest.mark.parametrize("times", [UniformTimes(), LogitNormalTimes(-0.4, 1.0), HighNoiseTimes()])
def test_intervals_are_ordered_and_hold_the_share_of_whole_ones(times):
    r, t = generator(times=times, boundary_share=0.25).intervals(4000, torch.Generator().manual_seed(0))
    assert ((r >= 0) & (r <= t) & (t <= 1)).all()
    whole = ((r == 0) & (t == 1)).float().mean()
    assert abs(whole - 0.25) < 0.03


@pytest.mark.parametrize("parametrisation", ["data", "velocity"])
def test_the_identity_holds_at_every_time_that_is_drawn(parametrisation):
    """The data form divides by t, so none is drawn near 0; bounding the division alone would break the identity."""

    class Exact(nn.Module):
        def forward(self, z, t, r, context):
            u = GaussianFlow()(z, t, r, context)
            return u if parametrisation == "velocity" else z - t[:, None, None] * u

    class NearData:
        def __call__(self, count, rng):
            return 0.03 * torch.rand(count, generator=rng, dtype=torch.float64)

    gen = generator(parametrisation=parametrisation, times=NearData())
    r, t = gen.intervals(64, torch.Generator().manual_seed(0))
    assert (t < 0.021).any()
    z, _, _ = draw(64)
    v = gen.velocity(Exact(), z, t, t, None)
    u, push = gen.linearise(Exact(), z, r.to(z), t, Context(), slice(None))
    torch.testing.assert_close(u + (t - r)[:, None, None] * push(v), v)


def test_high_noise_times_stay_near_one():
    t = HighNoiseTimes()(10_000, torch.Generator().manual_seed(0))
    assert t.min() > 0.02
    assert abs(t.mean() - (1 - 0.98 / 3)) < 0.01


@pytest.mark.parametrize(
    "changes", [{"parametrisation": "noise"}, {"compound_target": "teacher"}, {"compound_draws": 2}]
)
def test_impossible_choices_are_refused_by_name(changes):
    with pytest.raises(UserError, match=f"generator.{next(iter(changes))}"):
        generator(**changes)


def test_the_direction_comes_from_the_head_where_the_core_has_one():
    """u is off by one everywhere, the head is exact."""

    class TwoHeads(nn.Module):
        flow = GaussianFlow()

        def forward(self, z, t, r, context):
            return self.flow(z, t, r, context) + 1

        def instant(self, z, t, context):
            return self.flow(z, t, t, context)

    z, t, _ = draw()
    exact, off = (
        generator(v_from=source).instant_velocity(TwoHeads(), z, t, None) for source in ("head", "boundary")
    )
    torch.testing.assert_close(exact, GaussianFlow()(z, t, t, None))
    torch.testing.assert_close(off, exact + 1)
    assert generator(v_from="head").core_interface != generator().core_interface
