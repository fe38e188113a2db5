import pytest
import torch
from torch import nn

from imfvla.encoders.vision import AttentionStage, CompactResNet, ResidualBlock, ResNet18, attend_over_depth
from imfvla.errors import UserError


def increments(count=3, channels=16):
    torch.manual_seed(0)
    return [torch.randn(2, channels, 4, 5) * scale for scale in range(1, count + 1)]


def test_zero_queries_are_the_mean_of_the_history():
    maps = increments()
    torch.testing.assert_close(attend_over_depth(maps, torch.zeros(16)), torch.stack(maps).mean(0))


def test_attention_over_depth_follows_equations_12_and_14():
    maps, query = increments(), torch.randn(16)
    stacked = torch.stack(maps)
    keys = stacked / (stacked.square().mean(2, keepdim=True) + 1e-6).sqrt()
    weights = torch.einsum("snchw,c->snhw", keys, query).softmax(0)
    wanted = torch.einsum("snhw,snchw->nchw", weights, stacked)
    torch.testing.assert_close(attend_over_depth(maps, query), wanted)


def test_weights_sum_to_one_at_every_position():
    maps = increments()
    one = torch.ones_like(maps[0])
    shifted = attend_over_depth([one, one, one], torch.randn(16))
    torch.testing.assert_close(shifted, one)


def test_positions_do_not_see_each_other():
    maps, query = increments(), torch.randn(16)
    before = attend_over_depth(maps, query)
    maps[1] = maps[1].clone()
    maps[1][:, :, 2, 3] += 1.0
    changed = (attend_over_depth(maps, query) != before).any(1)
    assert changed[:, 2, 3].all()
    assert changed.sum() == 2


def test_a_stage_s_history_begins_with_its_input_at_the_stage_s_size():
    """Fresh: each block's sum is the mean of the shortcut and the increments so far."""
    torch.manual_seed(0)
    first, second = ResidualBlock(16, 32, 2), ResidualBlock(32, 32)
    stage = AttentionStage(first, second)
    x = torch.randn(2, 16, 8, 8)
    y0, y1 = first.shortcut(x), first.body(x)
    y2 = second.body(((y0 + y1) / 2).relu())
    torch.testing.assert_close(stage(x), ((y0 + y1 + y2) / 3).relu())


@pytest.mark.parametrize(
    "make", [ResNet18, lambda residual: CompactResNet((16, 16), 8, num_blocks=2, residual=residual)]
)
def test_both_residuals_have_the_same_weights_but_for_the_queries(make):
    standard, attention = make("standard").state_dict(), make("attention").state_dict()
    queries = [name for name in attention if name.endswith("query")]
    assert queries
    assert list(standard) == [name for name in attention if name not in queries]
    assert not any(attention[name].any() for name in queries)


@pytest.mark.parametrize("residual", ["standard", "attention"])
def test_every_parameter_learns(residual):
    torch.manual_seed(0)
    trunk = CompactResNet((16, 32), 8, num_blocks=2, residual=residual)
    for name, parameter in trunk.named_parameters():
        if name.endswith("query"):
            nn.init.normal_(parameter)
    trunk(torch.randn(2, 3, 32, 32)).square().sum().backward()
    assert [name for name, p in trunk.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_an_unknown_residual_is_refused():
    with pytest.raises(
        UserError, match=r"encoder\.vision\.residual must be standard or attention, found 'sum'"
    ):
        CompactResNet((16, 16), 8, num_blocks=2, residual="sum")
