from itertools import pairwise

import pytest
import torch
from torch import nn

from imfvla.errors import UserError
from imfvla.nn.residual import AttentionResidual, BlockAttentionResidual, StandardResidual

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


def reads(residual, count=7):
    """What each sublayer reads and what the stack returns, for increments that do not depend on it."""
    rng = torch.Generator().manual_seed(0)
    increments = torch.randn(count, 2, 3, WIDTH, generator=rng, dtype=torch.float64)
    history = residual.begin(increments[0])
    read = [history.read()]
    for increment in increments[1:]:
        history.add(increment)
        if len(read) < count - 1:
            read.append(history.read())
    return increments, read, history


@pytest.mark.parametrize("readout", ["sum", "attn"])
def test_blocks_of_one_sublayer_are_full_attention_residuals(readout):
    full = AttentionResidual(6, WIDTH, readout).double()
    nn.init.normal_(full.query)
    block = BlockAttentionResidual(6, WIDTH, 1, readout).double()
    block.load_state_dict(full.state_dict())
    (_, wanted, one), (_, found, other) = reads(full), reads(block)
    assert all(torch.equal(a, b) for a, b in zip(wanted, found, strict=True))
    assert torch.equal(one.readout(), other.readout())


def test_sources_of_block_attention_are_the_embedding_whole_blocks_and_the_sum_so_far():
    residual = BlockAttentionResidual(6, WIDTH, 4).double()
    nn.init.normal_(residual.query)
    increments, read, history = reads(residual)
    bounds = ((0, 1), (0, 1, 2), (0, 1, 3), (0, 1, 4), (0, 1, 5), (0, 1, 5, 6))  # of each sublayer's sources
    for sublayer, edges in enumerate(bounds):
        sources = torch.stack([increments[a:b].sum(0) for a, b in pairwise(edges)])
        keys = sources / (sources.square().mean(-1, keepdim=True) + 1e-6).sqrt()
        weights = (keys @ residual.query[sublayer]).softmax(0)
        torch.testing.assert_close(read[sublayer], (weights.unsqueeze(-1) * sources).sum(0))
    torch.testing.assert_close(history.readout(), increments.sum(0))
    torch.testing.assert_close(history.weights(5).sum(-1), torch.ones(2, 3, dtype=torch.float64))


@pytest.mark.parametrize("block_size", [1, 2, 3, 6])
def test_zero_queries_read_the_sum_of_all_increments_over_the_number_of_sources(block_size):
    increments, read, _ = reads(BlockAttentionResidual(6, WIDTH, block_size).double())
    for sublayer, found in enumerate(read):
        num_sources = 1 + -(-sublayer // block_size)
        torch.testing.assert_close(found, increments[: sublayer + 1].sum(0) / num_sources)


@pytest.mark.parametrize("block_size", [0, 7, 2.5])
def test_a_block_beyond_the_stack_is_refused(block_size):
    with pytest.raises(
        UserError,
        match=rf"core\.residual\.block_size .* 1 to the 6 sublayers .* found {block_size}: .*core\.depth",
    ):
        BlockAttentionResidual(6, WIDTH, block_size)
