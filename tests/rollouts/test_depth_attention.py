"""Recorded depth weights: distributions over earlier sublayers, and a core that computes what it did before."""

from functools import partial

import pytest
import torch
from torch import nn

from imfvla.errors import UserError
from imfvla.nn.residual import AttentionResidual, BlockAttentionResidual, StandardResidual
from imfvla.nn.transformer import TransformerCore
from imfvla.rollouts.depth_attention import ACTIONS, CONTEXT, DepthWeights, record_depth_weights

DEPTH = 3


def core_with(residual, velocity_head=False) -> TransformerCore:
    torch.manual_seed(0)
    core = TransformerCore(
        steps=8, channels=2, width=8, depth=DEPTH, heads=2, patch=4, mlp_ratio=2.0, max_rad=10.0, residual=residual,
        velocity_head=velocity_head,
    )  # fmt: skip
    for parameter in core.parameters():
        nn.init.normal_(parameter, std=0.3)
    return core


def run(core: TransformerCore) -> torch.Tensor:
    rng = torch.Generator().manual_seed(1)
    context = core.condition(torch.randn(2, 5, 8, generator=rng))
    t = torch.ones(2)
    return core(torch.randn(2, 8, 2, generator=rng), t, 0 * t, context)


@pytest.mark.parametrize("readout", ["sum", "attn"])
def test_every_sublayer_spreads_one_over_what_came_before(readout):
    core = core_with(partial(AttentionResidual, readout=readout))
    before = run(core)
    with record_depth_weights(core) as recorded:
        assert torch.equal(run(core), before)
        run(core)
    assert torch.equal(run(core), before)
    rows = recorded.rows(ACTIONS)
    assert [len(row) for row in rows] == list(range(1, 2 * DEPTH + 1 + (readout == "attn")))
    for row in rows:
        assert sum(row) == pytest.approx(1, abs=1e-5)
        assert min(row) >= 0
    assert [len(row) for row in recorded.rows(CONTEXT)] == [
        *range(1, 2 * DEPTH),
        *[0] * (1 + (readout == "attn")),
    ]


def test_where_both_velocities_have_blocks_those_that_sample_are_shown():
    core = core_with(AttentionResidual, velocity_head=True)
    nn.init.zeros_(core.average.residual.query)
    with record_depth_weights(core) as recorded:
        run(core)
    assert recorded.rows(ACTIONS)[3] == pytest.approx([0.25] * 4)
    assert recorded.rows(CONTEXT)[3] != pytest.approx([0.25] * 4, abs=1e-3)


def test_queries_of_zero_weigh_all_alike():
    core = core_with(AttentionResidual)
    nn.init.zeros_(core.residual.query)
    with record_depth_weights(core) as recorded:
        run(core)
    assert recorded.rows(ACTIONS)[3] == pytest.approx([0.25] * 4)


def test_the_mean_is_over_all_tokens_of_all_readings():
    weights = DepthWeights(2)
    weights.add(ACTIONS, 1, torch.tensor([[[0.25, 0.75]]]))
    weights.add(ACTIONS, 1, torch.tensor([[[0.5, 0.5], [1.0, 0.0]]]))
    assert weights.rows(ACTIONS) == [[], pytest.approx([1.75 / 3, 1.25 / 3])]
    assert weights.rows(CONTEXT) == [[], []]


def test_sums_of_blocks_are_the_sources_of_block_attention():
    core = core_with(partial(BlockAttentionResidual, block_size=2))
    with record_depth_weights(core) as recorded:
        run(core)
    assert [len(row) for row in recorded.rows(ACTIONS)] == [1, 2, 2, 3, 3, 4]


def test_a_core_with_fixed_sums_is_refused():
    core = core_with(StandardResidual)
    with (
        pytest.raises(UserError, match=r"must be Attention Residuals, found StandardResidual"),
        record_depth_weights(core),
    ):
        pass
