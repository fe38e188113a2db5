import pytest
import torch
from closed_forms import MEAN, STD, STEPS, Context, Recorded, columns, draw
from torch import nn

from imfvla.command.composition import compose
from imfvla.config.construction import construct
from imfvla.errors import UserError
from imfvla.generators.two_step import TwoStepRegression

LEVEL = 0.1


def generator(**changes) -> TwoStepRegression:
    return TwoStepRegression(**({"level": LEVEL, "draws": 3, "clip": 10.0} | changes))


class Optimum(nn.Module):
    """The best answers for Gaussian data: the mean from nothing, the conditional mean from a noisy action."""

    def __init__(self, off: float = 0.0):
        super().__init__()
        self.off = off

    def forward(self, z, t, r, context):
        if (t == 1).all():
            assert (z == 0).all()
            assert (r == 0).all()
            return MEAN.expand(len(z), -1, -1) + self.off
        torch.testing.assert_close(r, t)
        torch.testing.assert_close(t, torch.full_like(t, LEVEL))
        (t,) = columns(t)
        gain = (1 - t) * STD**2 / ((1 - t) ** 2 * STD**2 + t**2)
        return MEAN + gain * (z - (1 - t) * MEAN) + self.off


def losses(off=0.0, count=40_000):
    actions = MEAN + STD * draw(count)[0]
    valid = torch.ones(count, STEPS, dtype=torch.bool)
    return generator().loss(Optimum(off), Context(), actions, valid, torch.Generator().manual_seed(0))


def test_the_loss_of_the_optimum_is_the_variance_and_what_is_left_of_it_after_a_look():
    loss, logs = losses()
    left = 1 / (1 / STD**2 + ((1 - LEVEL) / LEVEL) ** 2)
    assert logs["squared_error"] == pytest.approx(float(STD.square().mean()), rel=0.03)
    assert logs["correction_error"] == pytest.approx(float(left.mean()), rel=0.03)
    assert loss.mean() == pytest.approx(float(logs["squared_error"] + logs["correction_error"]))


def test_both_answers_have_weight_one():
    assert losses(off=0.5)[0].mean() - losses()[0].mean() == pytest.approx(2 * 0.25, abs=0.02)


def test_the_second_call_is_given_the_first_answer_as_in_training_without_noise():
    seen = []

    class Watched(Optimum):
        def forward(self, z, t, r, context):
            seen.append(z)
            return super().forward(z, t, r, context)

    chunk = generator().sample(Watched(), None, draw(4)[0], 2)
    torch.testing.assert_close(seen[1], ((1 - LEVEL) * MEAN).expand(4, -1, -1))
    torch.testing.assert_close(chunk, MEAN.expand(4, -1, -1))


def test_it_is_no_sampler():
    core, (noise, _, _) = Recorded(), draw(4)
    assert torch.equal(generator().sample(core, None, noise, 2), generator().sample(core, None, 7 * noise, 2))


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_level_without_signal_or_without_noise_is_refused(level):
    config = compose("train", ["generator=two_step", f"generator.level={level}"])
    with pytest.raises(UserError, match=r"generator\.level must be between 0 and 1"):
        construct(config["generator"], "generator")
