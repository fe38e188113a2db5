"""ACT's network: padding changes no style, the style changes the chunk, every weight is reached."""

import pytest
import torch

from imfvla.errors import UserError
from imfvla.nn.act import ActCore

BATCH, STEPS, CHANNELS, TOKENS, WIDTH, STYLE = 3, 6, 2, 5, 16, 4


def make(**options) -> ActCore:
    torch.manual_seed(0)
    sizes = {
        "steps": STEPS, "channels": CHANNELS, "width": WIDTH, "heads": 2, "depth": 2, "decoder_depth": 1,
        "style_depth": 2, "style_width": STYLE, "state_token": -3, "mlp_ratio": 2.0, "dropout": 0.1,
    }  # fmt: skip
    return ActCore(**{**sizes, **options}).eval()


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(1)
    valid = torch.ones(BATCH, STEPS, dtype=torch.bool)
    valid[-1, 2:] = False
    context = torch.randn(BATCH, TOKENS, WIDTH, generator=rng)
    return context, torch.randn(BATCH, STEPS, CHANNELS, generator=rng), valid


def test_shapes():
    core, (context, actions, valid) = make(), inputs()
    mean, log_variance = core.style(context, actions, valid)
    assert mean.shape == log_variance.shape == (BATCH, STYLE)
    assert core(core.condition(context), mean).shape == (BATCH, STEPS, CHANNELS)


def test_padded_steps_have_no_style():
    core, (context, actions, valid) = make(), inputs()
    garbage = actions.masked_fill(~valid.unsqueeze(-1), 100.0)
    for found, expected in zip(
        core.style(context, garbage, valid), core.style(context, actions, valid), strict=True
    ):
        torch.testing.assert_close(found, expected)


def test_style_sees_the_state_and_no_other_token():
    core, (context, actions, valid) = make(), inputs()
    others = context + torch.randn_like(context)
    others[:, -3] = context[:, -3]
    assert torch.equal(core.style(others, actions, valid)[0], core.style(context, actions, valid)[0])
    moved = context.clone()
    moved[:, -3] += 1.0
    assert not torch.allclose(core.style(moved, actions, valid)[0], core.style(context, actions, valid)[0])


def test_chunk_depends_on_style_and_on_every_token():
    core, (context, _, _) = make(), inputs()
    style = torch.zeros(BATCH, STYLE)
    chunk = core(context, style)
    assert not torch.allclose(core(context, style + 1), chunk)
    for token in range(TOKENS):
        moved = context.clone()
        moved[:, token] += torch.arange(WIDTH) / WIDTH
        assert not torch.allclose(core(moved, style), chunk, atol=1e-6)


def test_heads_that_do_not_divide_the_width_are_refused():
    with pytest.raises(UserError, match=r"core\.heads must divide core\.width=16, found 3"):
        make(heads=3)
