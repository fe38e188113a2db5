import functools

import pytest
import torch
from torch import nn

from imfvla.nn.adaln import AdaptiveNormCore
from imfvla.nn.cross import CrossAttentionCore
from imfvla.nn.forward_mode import jvp
from imfvla.nn.residual import AttentionResidual, BlockAttentionResidual, StandardResidual
from imfvla.nn.transformer import TransformerCore

RESIDUALS = {
    "standard": StandardResidual,
    "attnres-sum": functools.partial(AttentionResidual, readout="sum"),
    "attnres-attn": functools.partial(AttentionResidual, readout="attn"),
    "block-sum": functools.partial(BlockAttentionResidual, block_size=4, readout="sum"),
    "block-attn": functools.partial(BlockAttentionResidual, block_size=4, readout="attn"),
}
CORES = {"token": TransformerCore, "cross": CrossAttentionCore, "adaln": AdaptiveNormCore}
each_core = pytest.mark.parametrize("conditioning", CORES)
each_residual = pytest.mark.parametrize("residual", RESIDUALS)


def make_core(residual, conditioning="token", depth=3, dtype=torch.float64, velocity_head=False):
    torch.manual_seed(0)
    core = CORES[conditioning](
        steps=8,
        channels=3,
        width=16,
        depth=depth,
        heads=2,
        patch=2,
        mlp_ratio=2.0,
        max_rad=10.0,
        residual=RESIDUALS[residual],
        velocity_head=velocity_head,
    ).to(dtype)
    for stack in (core, core.average) if velocity_head else (core,):
        nn.init.normal_(stack.output.weight, std=0.3)
        if residual != "standard":
            nn.init.normal_(stack.residual.query)
    return core


def inputs(batch=2, dtype=torch.float64):
    rng = torch.Generator().manual_seed(1)
    x, context = (torch.randn(batch, *shape, generator=rng, dtype=dtype) for shape in ((8, 3), (5, 16)))
    t = torch.tensor([0.9, 0.5], dtype=dtype)[:batch]
    return x, t, t / 3, context


@each_core
@each_residual
@pytest.mark.parametrize("head", ["u", "v"])
def test_jacobian_vector_product_equals_central_differences(head, residual, conditioning):
    core = make_core(residual, conditioning, velocity_head=True)
    x, t, r, context = inputs()
    cached = core.condition(context)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=x.dtype)
    step = 1e-5

    def f(x, t):
        return core(x, t, r, cached) if head == "u" else core.instant(x, t, cached)

    value, derivative = jvp(f, (x, t), (direction, torch.ones_like(t)))
    with torch.no_grad():
        difference = (f(x + step * direction, t + step) - f(x - step * direction, t - step)) / (2 * step)
        torch.testing.assert_close(value, f(x, t))
    assert (derivative - difference).norm() / difference.norm() < 1e-6


@each_core
@pytest.mark.parametrize("residual", ["attnres-sum", "block-sum"])
def test_fresh_attention_residuals_equal_the_standard_pre_norm_network(residual, conditioning):
    standard = make_core("standard", conditioning)
    attnres = make_core(residual, conditioning)
    attnres.load_state_dict(standard.state_dict(), strict=False)
    nn.init.zeros_(attnres.residual.query)
    for module in (*attnres.modules(), *standard.modules()):
        if isinstance(module, nn.LayerNorm):
            # the input of the pre-norm differs by a factor, which only a norm without epsilon removes
            module.eps = 0.0
    x, t, r, context = inputs()
    torch.testing.assert_close(
        attnres(x, t, r, attnres.condition(context)),
        standard(x, t, r, standard.condition(context)),
    )


@each_core
@each_residual
def test_cached_context_equals_one_joint_pass(residual, conditioning):
    """The prefix does not see the suffix: running it for each row alone or once for several draws is the same."""
    core = make_core(residual, conditioning)
    x, t, r, context = inputs()
    cached = core.condition(context)
    twice = cached.repeat(2)
    many = core(x.repeat_interleave(2, 0), t.repeat_interleave(2), r.repeat_interleave(2), twice)
    one = torch.cat(
        [core(x[i : i + 1], t[i : i + 1], r[i : i + 1], cached.rows(slice(i, i + 1))) for i in (0, 1)]
    )
    torch.testing.assert_close(many[::2], one)
    torch.testing.assert_close(many[1::2], one)


@each_core
def test_the_context_matters(conditioning):
    core = make_core("attnres-sum", conditioning)
    x, t, r, context = inputs()
    changed = context.clone()
    changed[:, -1] += 1.0  # of the summary alone, which every core reads
    assert not torch.allclose(core(x, t, r, core.condition(context)), core(x, t, r, core.condition(changed)))


@each_core
@pytest.mark.parametrize("residual", ["standard", "attnres-attn", "block-attn"])
def test_every_parameter_learns(residual, conditioning):
    core = make_core(residual, conditioning)
    x, t, r, context = inputs()
    core(x, t, r, core.condition(context)).square().sum().backward()
    assert [name for name, p in core.named_parameters() if p.grad is None or not p.grad.any()] == []


@each_core
@pytest.mark.parametrize("residual", ["standard", "attnres-attn"])
def test_both_velocities_have_blocks_of_their_own_and_share_the_context(residual, conditioning):
    """Each learns all of its own weights, and the average none of those that the instantaneous velocity has."""
    core = make_core(residual, conditioning, velocity_head=True)
    x, t, r, context = inputs()
    cached = core.condition(context)
    core(x, t, r, cached.detach(x.dtype)).square().sum().backward()
    own = {name for name, _ in core.average.named_parameters(prefix="average")}
    assert {name for name, p in core.named_parameters() if p.grad is not None and p.grad.any()} == own
    core.zero_grad(set_to_none=True)
    core.instant(x, t, cached).square().sum().backward()
    assert not own & {name for name, p in core.named_parameters() if p.grad is not None}


@each_core
@each_residual
def test_the_average_starts_as_the_instantaneous_velocity(residual, conditioning):
    core = make_core(residual, conditioning, velocity_head=True)
    x, t, _, context = inputs()
    cached = core.condition(context)
    instant = core.instant(x, t, cached)
    assert not torch.allclose(core(x, t, t, cached), instant)
    core.start_average()
    assert torch.equal(core(x, t, t, cached), instant)
    with torch.no_grad():
        core.output.weight.zero_()  # copied, not shared
    assert torch.equal(core(x, t, t, cached), instant)


def test_the_first_sublayer_has_one_source_and_its_query_no_gradient():
    core = make_core("attnres-sum")
    x, t, r, context = inputs()
    core(x, t, r, core.condition(context)).square().sum().backward()
    gradients = core.residual.query.grad.abs().sum(1)
    assert gradients[0] == 0
    assert (gradients[1:] > 0).all()


def test_a_patch_that_does_not_divide_the_horizon_is_refused():
    with pytest.raises(ValueError, match="must divide the 8 steps"):
        TransformerCore(
            steps=8,
            channels=3,
            width=16,
            depth=1,
            heads=2,
            patch=3,
            mlp_ratio=2.0,
            max_rad=10.0,
            residual=StandardResidual,
        )
