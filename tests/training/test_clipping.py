"""Clipping by the gradients' scale: outliers alone, whatever the loss."""

import math
from dataclasses import asdict, replace

import pytest
import torch
from tiny_policy import OPTIM

from imfvla.errors import UserError
from imfvla.options import build
from imfvla.training.clipping import Clipping
from imfvla.training.options import OptimOptions


def clipped_steps(norms, factor=2.0, norm=None):
    clipping = Clipping(factor, norm)
    return [step for step, value in enumerate(norms) if takes(clipping, value)]


def takes(clipping, norm, counts=True):
    return bool(
        clipping.clip([torch.zeros(3)], torch.tensor(norm, dtype=torch.float64), torch.tensor(counts))
    )


def norms(count=400):
    """Scattered by a factor of some 1.3, with an outlier in every fifty."""
    usual = torch.randn(count, generator=torch.Generator().manual_seed(0)).mul(0.25).exp().tolist()
    return [5 * value if step % 50 == 49 else value for step, value in enumerate(usual)]


@pytest.mark.parametrize("size", [1e-3, 1.0, 300.0])
def test_what_is_clipped_does_not_depend_on_the_size_of_the_loss(size):
    assert clipped_steps([size * value for value in norms()]) == clipped_steps(norms())


def test_outliers_are_clipped_and_the_rest_is_left_alone():
    found = clipped_steps(norms())
    assert set(range(49, 400, 50)) <= set(found)
    assert len(found) < 8 + 0.02 * 400


def test_an_outlier_hardly_moves_the_scale_and_a_lasting_change_is_followed():
    clipping = Clipping(2.0, None)
    for _ in range(100):
        takes(clipping, 1.0)
    takes(clipping, 1e6)
    assert clipping.state() == pytest.approx(1.0, abs=0.03)
    for _ in range(300):
        takes(clipping, 10.0)
    assert clipping.limit > 10
    assert not takes(clipping, 10.0)


def test_the_first_gradient_and_no_rule_have_no_limit():
    assert Clipping(2.0, None).limit == math.inf
    assert clipped_steps([1.0, 1e9], factor=None) == []


def test_a_fixed_norm_is_one_for_all():
    assert clipped_steps([0.5, 2.0, 0.9, 1.1], factor=None, norm=1.0) == [1, 3]


def test_gradients_are_scaled_as_pytorch_scales_them():
    gradients = [torch.randn(5, 3), torch.randn(7)]
    parameters = [torch.nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient.clone()
    norm = torch.nn.utils.clip_grad_norm_(parameters, 0.7)
    clipping = Clipping(None, 0.7)
    assert clipping.clip(gradients, norm, torch.tensor(True))
    assert all(torch.equal(own, p.grad) for own, p in zip(gradients, parameters, strict=True))


def test_a_norm_that_does_not_count_leaves_the_scale():
    clipping = Clipping(2.0, None)
    assert clipping.state() is None
    takes(clipping, math.nan, counts=False)
    assert clipping.state() is None
    takes(clipping, 3.0)
    takes(clipping, math.inf, counts=False)
    assert clipping.state() == 3.0
    assert Clipping(2.0, None, clipping.state()).limit == 6.0


@pytest.mark.parametrize(("key", "value"), [("clip_factor", 1.0), ("clip_norm", 0.0)])
def test_limits_that_would_stop_learning_are_refused(key, value):
    with pytest.raises(UserError, match=rf"optim\.{key}"):
        build(OptimOptions, asdict(replace(OPTIM, **{key: value})), "optim")
