"""Flow matching on Gaussian data, where the velocity is known exactly."""

import pytest
import torch
from closed_forms import MEAN, STD, STEPS, Context, GaussianFlow, Recorded, draw
from torch import nn

from imfvla.errors import UserError
from imfvla.generators.base import BetaTimes, UniformTimes, step_times
from imfvla.generators.flow import FlowMatching
from imfvla.generators.imf import ImprovedMeanFlow

OPTIONS = {
    "parametrisation": "velocity",
    "times": UniformTimes(),
    "time_power": 0.0,
    "adaptive_power": 0.0,
    "adaptive_offset": 1e-3,
    "draws": 1,
    "clip": 1e6,
}


def generator(**changes):
    return FlowMatching(**(OPTIONS | changes))


def loss(gen, core, actions, seed=4):
    valid = torch.ones(len(actions), STEPS, dtype=torch.bool)
    return gen.loss(core, Context(), actions, valid, torch.Generator().manual_seed(seed))


class Constant(nn.Module):
    def forward(self, x, t, r, context):
        return MEAN.expand(len(x), -1, -1)


def test_one_step_gives_the_mean_whatever_the_noise():
    sample = generator().sample(GaussianFlow(), None, draw()[0], 1)
    torch.testing.assert_close(sample, MEAN.expand_as(sample), rtol=1e-10, atol=1e-10)


def test_many_steps_give_samples_and_the_error_halves_with_the_step():
    noise, _, _ = draw()
    coarse, fine = (
        (generator().sample(GaussianFlow(), None, noise, nfe) - (MEAN + STD * noise)).abs().max()
        for nfe in (100, 200)
    )
    assert coarse < 0.1
    assert abs(fine / coarse - 0.5) < 0.05


def test_the_last_of_several_steps_starts_where_it_is_told():
    assert step_times(1, 0.3).tolist() == [1, 0]
    assert step_times(2, 0.3).tolist() == pytest.approx([1, 0.3, 0])
    assert step_times(3, 0.2).tolist() == pytest.approx([1, 0.6, 0.2, 0])
    assert step_times(4).tolist() == [1, 0.75, 0.5, 0.25, 0]
    noise, _, _ = draw()
    ones, low, flow = torch.ones(len(noise)), torch.full((len(noise),), 0.3), GaussianFlow()
    z = noise - 0.7 * flow(noise, ones, ones, None)
    expected = z - 0.3 * flow(z, low, low, None)
    torch.testing.assert_close(generator(last_step=0.3).sample(flow, None, noise, 2), expected)


@pytest.mark.parametrize("nfe", [1, 2, 100])
def test_constant_data_is_reached_whatever_the_noise(nfe):
    sample = generator(parametrisation="data").sample(Constant(), None, draw()[0], nfe)
    torch.testing.assert_close(sample, MEAN.expand_as(sample), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("tilt", [-0.1, 0.1])
@pytest.mark.parametrize("parametrisation", ["velocity", "data"])
def test_the_exact_velocity_has_the_least_loss(tilt, parametrisation):
    class Flow(nn.Module):
        def __init__(self, tilt):
            super().__init__()
            self.tilt = tilt

        def forward(self, x, t, r, context):
            v = GaussianFlow()(x, t, r, context) + self.tilt * x
            return v if parametrisation == "velocity" else x - t[:, None, None] * v

    actions = MEAN + STD * draw(4000)[0]
    gen = generator(parametrisation=parametrisation)
    assert loss(gen, Flow(0.0), actions)[0].mean() < loss(gen, Flow(tilt), actions)[0].mean()


def test_the_core_is_given_equal_times():
    class Watched(Recorded):
        def forward(self, x, t, r, context):
            assert torch.equal(t, r)
            return super().forward(x, t, r, context)

    gen, core = generator(), Watched()
    loss(gen, core, draw(4)[0])
    gen.sample(core, None, draw(4)[0], 3)


def test_weighted_by_the_squared_time_it_is_the_error_of_the_clean_action():
    def late(count, rng):
        return 0.1 + 0.9 * torch.rand(count, generator=rng)

    actions = MEAN + STD * draw(8)[0]
    found, logs = loss(
        generator(parametrisation="data", time_power=2.0, times=late, draws=3), Constant(), actions
    )
    torch.testing.assert_close(found, (MEAN - actions).square().mean((1, 2)))
    torch.testing.assert_close(logs["velocity_error"], found.mean())


def test_it_is_the_instantaneous_part_of_improved_mean_flow():
    actions = MEAN + STD * draw(8)[0]
    imf = ImprovedMeanFlow(
        **OPTIONS | {"draws": 2},
        boundary_share=0.0,
        v_from="boundary",
        instant_weight=1.0,
        compound_target="sample",
        compound_draws=1,
    )
    flow = generator(draws=2)
    assert torch.equal(
        loss(imf, Recorded(), actions)[1]["instant_error"],
        loss(flow, Recorded(), actions)[1]["velocity_error"],
    )


def test_the_final_sample_is_clamped():
    assert generator(clip=0.1).sample(GaussianFlow(), None, draw()[0], 5).abs().max() == 0.1


def test_beta_times_have_the_moments_of_the_distribution():
    t = BetaTimes(1.5, 0.999)(100_000, torch.Generator().manual_seed(0))
    assert t.min() >= 0.001
    assert t.max() <= 1
    assert abs(t.mean() - (0.001 + 0.999 * 1.5 / 2.5)) < 0.005
    assert abs(t.var() - 0.999**2 * 1.5 / (2.5**2 * 3.5)) < 0.002


@pytest.mark.parametrize("changes", [{"parametrisation": "noise"}, {"draws": 0}])
def test_impossible_choices_are_refused_by_name(changes):
    with pytest.raises(UserError, match=f"generator.{next(iter(changes))}"):
        generator(**changes)
