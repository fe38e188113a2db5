import pytest
import torch
from torch import nn

from imfvla.training.ema import Ema, decay_at


def test_a_parameter_that_begins_later_forgets_what_it_began_with():
    policy = nn.Linear(1, 1)
    average = Ema(policy, 0.999, {"weight": (100, 200)})
    with torch.no_grad():
        policy.weight.fill_(5.0)
        for step in range(130):
            average.update(step)
            assert step >= 100 or average.policy.weight != 5.0
    torch.testing.assert_close(average.policy.weight, policy.weight, rtol=1e-4, atol=0)


def test_a_parameter_that_no_longer_learns_takes_its_average_and_stays():
    policy = nn.Linear(1, 1)
    average = Ema(policy, 0.9, {"weight": (0, 3)})
    with torch.no_grad():
        for step in range(3):
            policy.weight.fill_(float(step))
            average.update(step)
    average.settle(2)
    assert policy.weight == 2.0
    average.settle(3)
    kept = average.policy.weight.clone()
    assert policy.weight == kept != 2.0
    assert (policy.weight.requires_grad, policy.bias.requires_grad) == (False, True)
    with torch.no_grad():
        policy.weight.fill_(9.0)
    average.update(3)
    assert average.policy.weight == kept


def test_decay_rises_to_its_limit():
    assert decay_at(0, 0.999) == 0.1
    assert decay_at(90, 0.999) == 0.91
    assert decay_at(100_000, 0.999) == 0.999


def test_average_closed_form():
    source = nn.Linear(1, 1, bias=False)
    nn.init.constant_(source.weight, 1.0)
    ema = Ema(source, limit=0.5)
    expected = 1.0
    for step, weight in enumerate([2.0, -1.0, 4.0]):
        nn.init.constant_(source.weight, weight)
        ema.update(step)
        decay = min(0.5, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * weight
    assert ema.policy.weight.item() == pytest.approx(expected)


def test_copies_buffers_and_shares_no_memory():
    source = nn.BatchNorm1d(2)
    ema = Ema(source, limit=0.9)
    source(torch.randn(8, 2))
    ema.update(0)
    assert torch.equal(ema.policy.running_mean, source.running_mean)
    assert not ema.policy.training
    assert not any(parameter.requires_grad for parameter in ema.policy.parameters())
    assert ema.policy.weight.data_ptr() != source.weight.data_ptr()
