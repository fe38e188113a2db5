import pytest
import torch
from closed_forms import MEAN, STEPS, Context, Recorded, draw
from torch import nn

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
    loss, logs = Regression(clip=10.0).loss(Constant(), Context(), actions, valid, torch.Generator())
    error = (actions - MEAN).abs()
    torch.testing.assert_close(loss, torch.stack((error[0].mean(), error[1, 0].mean())))
    torch.testing.assert_close(logs["absolute_error"], loss.mean())


def test_the_noise_changes_nothing():
    core, (noise, _, _) = Recorded(), draw(4)
    chunk = Regression(clip=10.0).sample(core, None, noise, 1)
    assert torch.equal(chunk, Regression(clip=10.0).sample(core, None, 7 * noise, 1))


def test_the_prediction_is_clamped():
    chunk = Regression(clip=0.2).sample(Constant(), None, draw(4)[0], 1)
    assert torch.equal(chunk, MEAN.clamp(-0.2, 0.2).expand_as(chunk))


def test_more_than_one_step_is_refused_in_one_sentence_that_names_both_sides():
    with pytest.raises(
        UserError, match=r"^nfe, .*, must be 1 with generator=l1 \(one-step regression\), found 3\.$"
    ):
        Regression(clip=10.0).sample(Constant(), None, draw(4)[0], 3)
