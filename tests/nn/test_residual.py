import pytest
import torch
from torch import nn

from imfvla.nn.residual import AttentionResidual, StandardResidual

WIDTH = 8


def histories(residual, count=4):
    rng = torch.Generator().manual_seed(0)
    increments = [torch.randn(2, 3, WIDTH, generator=rng) for _ in range(count)]
    history = residual.begin(increments[0])
    for increment in increments[1:]:
        history.add(increment)
    return history, torch.stack(increments)


def trained(readout="sum"):
    residual = AttentionResidual(6, WIDTH, readout)
    nn.init.normal_(residual.query)
    return residual


def test_zero_queries_read_the_uniform_average_of_all_increments():
    history, increments = histories(AttentionResidual(6, WIDTH))
    torch.testing.assert_close(history.read(), increments.mean(0))


def test_weights_are_positive_and_sum_to_one():
    history, _ = histories(trained())
    weights = history.weights(3)
    assert weights.shape == (2, 3, 4)
    assert (weights > 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 3))


def test_reading_follows_equations_12_and_14():
    residual = trained()
    history, increments = histories(residual)
    keys = increments / (increments.square().mean(-1, keepdim=True) + 1e-6).sqrt()
    weights = (keys @ residual.query[3]).softmax(0)
    torch.testing.assert_close(history.read(), (weights.unsqueeze(-1) * increments).sum(0))


def test_weights_do_not_depend_on_the_scale_of_an_increment():
    residual = trained()
    history, increments = histories(residual)
    scaled = residual.begin(5 * increments[0])
    for increment in increments[1:]:
        scaled.add(increment)
    torch.testing.assert_close(scaled.weights(3), history.weights(3), rtol=1e-4, atol=1e-5)


def test_readout_is_the_sum_of_equation_13_or_an_aggregation_of_its_own():
    history, increments = histories(trained("sum"))
    torch.testing.assert_close(history.readout(), increments.sum(0))
    residual = trained("attn")
    history, increments = histories(residual)
    assert len(residual.query) == 7
    torch.testing.assert_close(history.readout(), history.aggregate(6))


def test_standard_residual_reads_and_returns_the_running_sum():
    history, increments = histories(StandardResidual(6, WIDTH))
    torch.testing.assert_close(history.read(), increments.sum(0))
    torch.testing.assert_close(history.readout(), increments.sum(0))


def test_unknown_readout_is_refused():
    with pytest.raises(ValueError, match="'sum' or 'attn'"):
        AttentionResidual(6, WIDTH, "mean")
