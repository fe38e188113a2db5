"""The original Mean Flow on Gaussian data, where the average velocity is known exactly."""

import pytest
import torch
from closed_forms import MEAN, STD, STEPS, Context, GaussianFlow, Recorded, columns, draw

from imfvla.errors import UserError
from imfvla.generators.base import UniformTimes
from imfvla.generators.meanflow import MeanFlow
from imfvla.nn.forward_mode import jvp


def generator(**changes):
    options = {
        "parametrisation": "velocity",
        "times": UniformTimes(),
        "boundary_share": 0.0,
        "time_power": 0.0,
        "adaptive_power": 0.0,
        "adaptive_offset": 1e-3,
        "draws": 1,
        "compound_draws": 1,
        "clip": 1e6,
    }
    return MeanFlow(**(options | changes))


def target(flow, z, r, t, v):
    gen = generator()
    _, push = gen.linearise(flow, z, r, t, Context(), slice(None))
    return gen.target(push, r, t, v)


def test_along_the_marginal_velocity_the_target_of_the_exact_flow_is_itself():
    z, t, r = draw()
    flow = GaussianFlow()
    found, _ = target(flow, z, r, t, flow(z, t, t, None))
    torch.testing.assert_close(found, flow(z, r=r, t=t, context=None), rtol=1e-10, atol=1e-10)


def test_a_flipped_sign_breaks_the_identity():
    z, t, r = draw()
    flow = GaussianFlow()
    found, change = target(flow, z, r, t, flow(z, t, t, None))
    assert (found + 2 * change - flow(z, t, r, None)).abs().max() > 0.1


def test_the_target_is_linear_in_the_velocity():
    """So its mean over the conditional velocities at z is the target along the marginal one, which is right."""
    z, t, r = draw()
    one, other = torch.randn(2, *z.shape, generator=torch.Generator().manual_seed(0), dtype=z.dtype)
    first, second, between = (target(Recorded(), z, r, t, v)[0] for v in (one, other, (one + other) / 2))
    torch.testing.assert_close((first + second) / 2, between)


@pytest.mark.parametrize("nfe", [1, 2, 3])
def test_any_number_of_exact_steps_maps_noise_to_data(nfe):
    noise, _, _ = draw()
    sample = generator().sample(GaussianFlow(), None, noise, nfe)
    torch.testing.assert_close(sample, MEAN + STD * noise, rtol=1e-10, atol=1e-10)


def test_loss_and_gradient_are_those_of_a_regression_on_a_fixed_target():
    """First draw of each observation: an interval; second: r = t, plain flow matching."""
    core, gen = Recorded(), generator(draws=2, time_power=1.0)
    actions = MEAN + STD * draw(8)[0]
    valid = torch.ones(8, STEPS, dtype=torch.bool)
    valid[0, 1:] = False
    found, _ = gen.loss(core, Context(), actions, valid, torch.Generator().manual_seed(4))

    rng = torch.Generator().manual_seed(4)
    x = actions.repeat_interleave(2, dim=0)
    noise = torch.randn(x.shape, generator=rng).to(x)
    r, t = (time.to(x) for time in gen.intervals(16, rng))
    r[1::2] = t[1::2]
    t3, r3 = columns(t, r)
    z, v = (1 - t3) * x + t3 * noise, noise - x
    _, dudt = jvp(lambda z, t: core(z, t, r, None), (z, t), (v, torch.ones_like(t)))
    error = (core(z, t, r, None) - (v - (t3 - r3) * dudt)).square().mean(-1)
    kept = valid.repeat_interleave(2, dim=0)
    expected = (t * (error * kept).sum(1) / kept.sum(1)).reshape(8, 2).mean(1)
    torch.testing.assert_close(found, expected)
    weights = list(core.parameters())
    for gradient, wanted in zip(
        torch.autograd.grad(found.mean(), weights),
        torch.autograd.grad(expected.mean(), weights),
        strict=True,
    ):
        torch.testing.assert_close(gradient, wanted)


def test_more_intervals_than_draws_are_refused_by_name():
    with pytest.raises(
        UserError, match=r"generator\.compound_draws must lie between 1 and generator\.draws=1"
    ):
        generator(compound_draws=2)
