"""Two stages on Gaussian data, where the average velocity of an exact flow is known."""

import pytest
import torch
from closed_forms import CHANNELS, MEAN, STD, STEPS, Context, GaussianFlow, columns, draw
from torch import nn

from imfvla.command.composition import compose
from imfvla.config.construction import construct
from imfvla.errors import UserError
from imfvla.generators.base import UniformTimes
from imfvla.generators.staged import StagedMeanFlow
from imfvla.nn.residual import AttentionResidual
from imfvla.nn.transformer import TransformerCore


def generator(**changes):
    options = {
        "parametrisation": "velocity",
        "times": UniformTimes(),
        "velocity_head": True,
        "average_from": 0.5,
        "path_steps": 4,
        "boundary_share": 0.25,
        "time_power": 0.0,
        "adaptive_power": 0.0,
        "adaptive_offset": 1e-3,
        "draws": 2,
        "clip": 1e6,
    }
    return StagedMeanFlow(**(options | changes))


class ExactFlow(nn.Module):
    """Both velocities of Gaussian data, in either parametrisation; what the average says is off by `off`."""

    def __init__(self, parametrisation="velocity", off=0.0):
        super().__init__()
        self.flow, self.parametrisation, self.off = GaussianFlow(), parametrisation, off

    def forward(self, z, t, r, context):
        return self.output(z, t, self.flow(z, t, r, context) + self.off)

    def instant(self, z, t, context):
        return self.output(z, t, self.flow(z, t, t, context))

    def output(self, z, t, velocity):
        (column,) = columns(t)
        return velocity if self.parametrisation == "velocity" else z - column * velocity


class Core(TransformerCore):
    """A small one with both velocities, whose every weight matters from the start."""

    def __init__(self):
        torch.manual_seed(0)
        super().__init__(
            steps=STEPS,
            channels=CHANNELS,
            width=8,
            depth=2,
            heads=2,
            patch=1,
            mlp_ratio=2.0,
            max_rad=10.0,
            residual=lambda sublayers, width: AttentionResidual(sublayers, width, readout="sum"),
            velocity_head=True,
        )
        for stack in (self, self.average):
            nn.init.normal_(stack.output.weight, std=0.3)


@pytest.mark.parametrize("parametrisation", ["velocity", "data"])
def test_the_path_s_mean_velocity_converges_to_the_average_one(parametrisation):
    """Euler's error is of the first order: twice the steps halve it."""
    z, t, r = draw()
    core = ExactFlow(parametrisation)
    exact = GaussianFlow()(z, t, r, None)
    errors = [
        (generator(parametrisation=parametrisation, path_steps=n).path_velocity(core, z, r, t, None) - exact)
        .abs()
        .max()
        for n in (64, 128, 1024)
    ]
    assert 1.8 < errors[0] / errors[1] < 2.2
    assert errors[2] < 0.01


def test_one_step_of_a_path_of_no_length_is_the_instantaneous_velocity():
    z, t, _ = draw()
    torch.testing.assert_close(
        generator(path_steps=1).path_velocity(ExactFlow(), z, t, t, None), GaussianFlow()(z, t, t, None)
    )


def test_the_exact_average_velocity_has_next_to_no_loss_and_another_has_its_distance():
    actions = MEAN + STD * draw(256)[0]
    valid = torch.ones(256, STEPS, dtype=torch.bool)
    found = []
    for off in (0.0, 0.5):
        gen = generator(path_steps=256)
        gen.begin_step(None, 2, 2)
        _, logs = gen.loss(ExactFlow(off=off), Context(), actions, valid, torch.Generator().manual_seed(0))
        found.append(logs["average_error"])
    assert found[0] < 1e-4
    assert found[1] == pytest.approx(0.25, abs=0.01)


def test_the_second_stage_starts_at_its_share_of_the_training_and_copies_once():
    core, gen = Core(), generator(average_from=0.6)
    own = dict(core.average.named_parameters())
    first = {name: parameter.clone() for name, parameter in own.items()}
    instant = {name: parameter for name, parameter in core.named_parameters() if name in own}
    for step in range(5):
        gen.begin_step(core, step, 5)
        assert gen.learns_average == (step >= 3)
        expected = first if step < 3 else instant
        assert all(torch.equal(own[name], expected[name]) for name in own)
    with torch.no_grad():
        core.output.weight.add_(1.0)
    gen.begin_step(core, 4, 5)
    assert not torch.equal(core.average.output.weight, core.output.weight)


def test_each_stage_reaches_its_own_blocks_alone():
    """Context and instantaneous velocity learn in the first stage, the average velocity in the second."""
    for step in (0, 2):
        core, gen = Core(), generator()
        seen = torch.randn(4, 3, 8, generator=torch.Generator().manual_seed(2), requires_grad=True)
        gen.begin_step(core, step, 2)
        actions, valid = draw(4)[0].float(), torch.ones(4, STEPS, dtype=torch.bool)
        loss, logs = gen.loss(core, core.condition(seen), actions, valid, torch.Generator().manual_seed(1))
        loss.mean().backward()
        assert [name for name, error in logs.items() if error > 0] == [
            ("instant_error", "average_error")[step // 2]
        ]
        assert (seen.grad is not None) == (step == 0)
        for name, parameter in core.named_parameters():
            is_learned = gen.span(f"core.{name}", 2)[0] <= step // 2 < gen.span(f"core.{name}", 2)[1]
            assert (parameter.grad is not None) == is_learned, name


def test_encoder_and_instantaneous_velocity_learn_first_and_the_average_afterwards():
    gen = generator(average_from=0.7)
    assert gen.span("encoder.state.0.weight", 10) == gen.span("core.output.weight", 10) == (0, 7)
    assert gen.span("core.average.output.weight", 10) == (7, 10)


@pytest.mark.parametrize("parametrisation", ["velocity", "data"])
def test_more_steps_than_one_follow_v_where_the_average_is_of_the_whole_interval_alone(parametrisation):
    """An average that is off by 1 everywhere shows in the one step that is taken with it."""
    noise, _, _ = draw(8)
    core, flow = ExactFlow(parametrisation, off=1.0), ExactFlow(parametrisation)
    whole = generator(parametrisation=parametrisation, boundary_share=1.0)
    exact = MEAN + STD * noise
    torch.testing.assert_close(whole.sample(core, None, noise, 1), exact - 1)
    torch.testing.assert_close(whole.sample(core, None, noise, 400), exact, rtol=0, atol=0.02)
    parts = generator(parametrisation=parametrisation, boundary_share=0.9)
    assert (parts.sample(core, None, noise, 2) - exact).abs().min() > 0.3
    torch.testing.assert_close(parts.sample(flow, None, noise, 2), exact)


@pytest.mark.parametrize(
    "change", ["average_from=1.0", "average_from=-0.1", "path_steps=0", "velocity_head=false"]
)
def test_impossible_choices_are_refused_by_name(change):
    config = compose("train", ["generator=imf", f"generator.{change}"])
    with pytest.raises(UserError, match=rf"generator\.{change.split('=')[0]}"):
        construct(config["generator"], "generator")


def test_one_step_needs_weights_of_the_second_stage():
    gen = generator(boundary_share=1.0, average_from=0.75)
    gen.check_nfe(1)
    gen.begin_step(Core(), 1, 4)
    gen.check_nfe(2)
    with pytest.raises(
        UserError, match=r"nfe=1 follows the average velocity.* in the last 25%.*Take later weights"
    ):
        gen.check_nfe(1)
    gen.begin_step(Core(), 3, 4)
    gen.check_nfe(1)


def test_one_step_learns_what_the_path_s_own_steps_give():
    """Of an uneven path too: noise less the learned mean velocity is where v ends in as many steps."""
    noise, _, _ = draw(8)
    gen = generator(boundary_share=1.0, path_steps=3, last_step=0.2)
    start, end = torch.ones(8).to(noise), torch.zeros(8).to(noise)
    learned = noise - gen.path_velocity(ExactFlow(), noise, end, start, None)
    torch.testing.assert_close(learned, gen.sample(ExactFlow(), None, noise, 3))
    assert (learned - gen.sample(ExactFlow(), None, noise, 4)).abs().max() > 1e-3
