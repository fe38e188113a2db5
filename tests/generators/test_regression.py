import pytest
import torch
from closed_forms import MEAN, STEPS, Context, Recorded, draw
from torch import nn

from imfvla.command.composition import compose
from imfvla.config.construction import construct
from imfvla.errors import UserError
from imfvla.generators.regression import Regression


class Constant(nn.Module):
    def forward(self, x, t, r, context):
        assert (x == 0).all()
        assert (t == 1).all()
        assert (r == 0).all()
        return MEAN.expand(len(x), -1, -1)


def test_the_loss_is_the_mean_absolute_error_over_valid_steps():
    actions, _, _ = draw(2)
    valid = torch.ones(2, STEPS, dtype=torch.bool)
    valid[1, 1:] = False
    loss, logs = Regression(clip=10.0, power=1).loss(Constant(), Context(), actions, valid, torch.Generator())
    error = (actions - MEAN).abs()
    torch.testing.assert_close(loss, torch.stack((error[0].mean(), error[1, 0].mean())))
    torch.testing.assert_close(logs["absolute_error"], loss.mean())


def test_the_squared_error_is_that_of_the_mean():
    actions, _, _ = draw(2)
    valid = torch.ones(2, STEPS, dtype=torch.bool)
    loss, logs = Regression(clip=10.0, power=2).loss(Constant(), Context(), actions, valid, torch.Generator())
    torch.testing.assert_close(loss, (actions - MEAN).square().mean((1, 2)))
    torch.testing.assert_close(logs["squared_error"], loss.mean())


@pytest.mark.parametrize(("power", "optimum"), [(1, 0.0), (2, 0.25)])
def test_the_optimum_is_the_median_or_the_mean(power, optimum):
    """Of three actions at 0 and one at 1."""

    class Constant(nn.Module):
        def __init__(self, value):
            super().__init__()
            self.value = value

        def forward(self, x, t, r, context):
            return torch.full_like(x, self.value)

    actions = torch.tensor([0.0, 0.0, 0.0, 1.0]).reshape(4, 1, 1)
    valid = torch.ones(4, 1, dtype=torch.bool)
    values = torch.linspace(0, 1, 21).tolist()
    losses = [
        Regression(clip=10.0, power=power).loss(Constant(value), None, actions, valid, None)[0].mean()
        for value in values
    ]
    assert values[int(torch.stack(losses).argmin())] == pytest.approx(optimum)


def test_another_power_is_refused():
    config = compose("train", ["generator=l1", "generator.power=3"])
    with pytest.raises(UserError, match=r"^generator\.power must be .*1.*2.*, found 3\.$"):
        construct(config["generator"], "generator")


def test_the_noise_changes_nothing():
    core, (noise, _, _) = Recorded(), draw(4)
    chunk = Regression(clip=10.0, power=1).sample(core, None, noise, 1)
    assert torch.equal(chunk, Regression(clip=10.0, power=1).sample(core, None, 7 * noise, 1))


def test_the_prediction_is_clamped():
    chunk = Regression(clip=0.2, power=1).sample(Constant(), None, draw(4)[0], 1)
    assert torch.equal(chunk, MEAN.clamp(-0.2, 0.2).expand_as(chunk))


@pytest.mark.parametrize("power", [1, 2])
def test_more_than_one_evaluation_is_refused_in_one_sentence_that_names_both_sides(power):
    with pytest.raises(
        UserError, match=rf"^nfe, .*, must be 1 with generator=l{power} \(one-step regression\), found 3\.$"
    ):
        Regression(clip=10.0, power=power).sample(Constant(), None, draw(4)[0], 3)
