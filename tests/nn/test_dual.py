"""Dual numbers against PyTorch's forward mode, for every core and with every generator that takes a derivative."""

import copy
from types import SimpleNamespace

import pytest
import torch
from test_smolvla_core import inputs as smolvla_inputs
from test_smolvla_core import make_core as make_smolvla
from test_transformer import CORES, RESIDUALS, inputs, make_core
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from imfvla.generators.base import UniformTimes
from imfvla.generators.imf import ImprovedMeanFlow
from imfvla.generators.meanflow import MeanFlow
from imfvla.nn.dual import Tape, shifted, total
from imfvla.nn.forward_mode import jvp
from imfvla.policy.prefix import GivenContext, GivenCore

TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-5}
each_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
each_transformer = pytest.mark.parametrize(
    ("conditioning", "residual"), [(core, residual) for core in CORES for residual in RESIDUALS]
)


def assert_near(found, expected, dtype):
    """Within the type's share of the largest number."""
    torch.testing.assert_close(found, expected, rtol=0, atol=float(TOLERANCE[dtype] * expected.abs().max()))


def dual_pass(call, x, t, r, rows):
    """Value, and what gives the tangent of `rows` along (dx, dt, dr)."""
    tape = Tape(rows)
    x, t, r = (tape.input(value) for value in (x, t, r))
    output = call(x, t, r)
    return output.value, lambda dx, dt, dr: tape.push(output, (x, dx), (t, dt), (r, dr))


def directions(x, t):
    rng = torch.Generator().manual_seed(2)
    return tuple(torch.randn(value.shape, generator=rng, dtype=value.dtype) for value in (x, t, t))


@each_dtype
@each_transformer
def test_values_and_tangents_of_every_core_are_those_of_forward_mode(conditioning, residual, dtype):
    core = make_core(residual, conditioning, dtype=dtype, velocity_head=True)
    x, t, r, context = inputs(dtype=dtype)
    cached = core.condition(context)
    along = directions(x, t)
    calls = (
        lambda x, t, r: core(x, t, r, cached),
        lambda x, t, r: core.instant(x, t, cached),
    )
    for call in calls:
        value, expected = jvp(call, (x, t, r), along)
        found, push = dual_pass(call, x, t, r, slice(None))
        assert_near(found.detach(), value, dtype)
        assert found.requires_grad
        tangent = push(*along)
        assert_near(tangent, expected, dtype)
        assert not tangent.requires_grad


@each_dtype
def test_values_and_tangents_of_smolvla_are_those_of_forward_mode(dtype):
    core = make_smolvla().to(dtype)
    x, t, r, context = (value.to(dtype) for value in smolvla_inputs())
    cached = core.condition(context)
    along = directions(x, t)
    value, expected = jvp(lambda x, t, r: core(x, t, r, cached), (x, t, r), along)
    found, push = dual_pass(lambda x, t, r: core(x, t, r, cached), x, t, r, slice(None))
    assert_near(found, value, dtype)
    assert_near(push(*along), expected, dtype)


@each_transformer
@pytest.mark.parametrize("rows", [slice(1, None), torch.tensor([1])], ids=["slice", "index"])
def test_some_rows_alone_have_a_tangent(conditioning, residual, rows):
    core = make_core(residual, conditioning)
    x, t, r, context = inputs()
    cached = core.condition(context)
    along = directions(x, t)
    _, expected = jvp(lambda x, t, r: core(x, t, r, cached), (x, t, r), along)
    _, push = dual_pass(lambda x, t, r: core(x, t, r, cached), x, t, r, rows)
    torch.testing.assert_close(push(*(value[rows] for value in along)), expected[rows])


@each_transformer
def test_gradients_of_a_dual_pass_are_those_of_a_plain_one(conditioning, residual):
    core = make_core(residual, conditioning)
    x, t, r, context = inputs()
    weights = list(core.parameters())
    plain = core(x, t, r, core.condition(context))
    dual, _ = dual_pass(lambda x, t, r: core(x, t, r, core.condition(context)), x, t, r, slice(None))
    torch.testing.assert_close(dual, plain)
    gradients = (torch.autograd.grad(value.square().sum(), weights) for value in (dual, plain))
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@each_transformer
def test_a_tangent_costs_one_product_with_each_constant(conditioning, residual):
    """The products of a forward pass, and a second one where both factors depend on the input."""
    core = make_core(residual, conditioning)
    x, t, r, context = inputs()
    cached = core.condition(context).detach(x.dtype)
    with FlopCounterMode(display=False) as plain:
        _, push = dual_pass(lambda x, t, r: core(x, t, r, cached), x, t, r, slice(None))
    with FlopCounterMode(display=False) as pushed:
        push(*directions(x, t))
    assert 1.0 <= pushed.get_total_flops() / plain.get_total_flops() < 1.2


def options(**changes):
    return {
        "parametrisation": "data", "times": UniformTimes(), "boundary_share": 0.2, "time_power": 2.0,
        "adaptive_power": 0.5, "adaptive_offset": 1e-3, "draws": 3, "compound_draws": 2, "clip": 10.0,
    } | changes  # fmt: skip


def imf(**changes):
    settings = {"v_from": "boundary", "instant_weight": 1.0, "compound_target": "sample"}
    return ImprovedMeanFlow(**options(**(settings | changes)))


GENERATORS = {
    "imf": imf,
    "imf, velocity": lambda: imf(parametrisation="velocity"),
    "imf, v of its own": lambda: imf(v_from="head"),
    "imf, target v": lambda: imf(compound_target="network"),
    "meanflow": lambda: MeanFlow(**options()),
}


def loss_and_gradients(generator, core, takes_duals, dtype, given):
    core = copy.deepcopy(core)
    core.takes_duals = takes_duals
    x, _, _, context = inputs(dtype=dtype)
    called, cached = core, core.condition(context)
    if given:
        first = torch.arange(x.shape[1])[:, None] < torch.tensor([2, 5])[:, None, None]
        called, cached = GivenCore(core), GivenContext(cached, x, first)
    valid = torch.ones(x.shape[:2], dtype=torch.bool)
    loss, logs = generator.loss(called, cached, x, valid, torch.Generator().manual_seed(3))
    loss.sum().backward()
    gradients = {name: p.grad for name, p in core.named_parameters() if p.grad is not None}
    return {"loss": loss.detach()} | logs | gradients


@each_dtype
@pytest.mark.parametrize("given", [False, True], ids=["free", "given"])
@pytest.mark.parametrize("name", GENERATORS)
@pytest.mark.parametrize("residual", RESIDUALS)
def test_losses_and_gradients_are_those_with_forward_mode(residual, name, given, dtype):
    generator = GENERATORS[name]()
    core = make_core(residual, dtype=dtype, velocity_head=generator.core_interface != "flow")
    found, expected = (loss_and_gradients(generator, core, duals, dtype, given) for duals in (True, False))
    assert found.keys() == expected.keys()
    for key, wanted in expected.items():
        assert_near(found[key], wanted, dtype)


@pytest.mark.parametrize("conditioning", ["cross", "adaln"])
def test_losses_of_other_cores_are_those_with_forward_mode(conditioning):
    core = make_core("attnres-attn", conditioning)
    found, expected = (loss_and_gradients(imf(), core, duals, torch.float64, True) for duals in (True, False))
    for key, wanted in expected.items():
        assert_near(found[key], wanted, torch.float64)


def test_the_derivative_is_taken_in_full_precision_under_autocast():
    core = make_core("attnres-sum", dtype=torch.float32)
    x, t, r, context = inputs(dtype=torch.float32)
    cached = core.condition(context)
    made = imf()

    def derivative():
        return made.linearise(core, x, r, t, cached, slice(1, None))[1](x[1:])

    exact = derivative()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_near(derivative(), exact, torch.float32)


def test_attention_residuals_learn_under_autocast():
    core = make_core("attnres-attn", dtype=torch.float32)
    nn.init.zeros_(core.residual.query)
    x, t, r, context = inputs(dtype=torch.float32)
    weights = list(core.parameters())
    exact = torch.autograd.grad(core(x, t, r, core.condition(context)).sum(), weights)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = core(x, t, r, core.condition(context))
    for found, expected in zip(torch.autograd.grad(output.float().sum(), weights), exact, strict=True):
        assert (found - expected).norm() < 0.1 * expected.norm() + 1e-3


def test_value_and_derivative_compile_as_one_graph():
    core = make_core("attnres-sum", depth=1)
    x, t, r, context = inputs()
    cached = core.condition(context)

    def both(x, t, r, dx):
        value, push = dual_pass(lambda x, t, r: core(x, t, r, cached), x, t, r, slice(None))
        return value, push(dx, torch.ones_like(t), torch.zeros_like(r))

    try:
        found = torch.compile(both, backend="eager", fullgraph=True)(x, t, r, x)
    finally:
        torch.compiler.reset()
    for one, other in zip(found, both(x, t, r, x), strict=True):
        torch.testing.assert_close(one, other)


def test_operators_follow_the_rules_of_calculus():
    tape = Tape(slice(None))
    x, y = (tape.input(torch.tensor([value], dtype=torch.float64)) for value in (2.0, 5.0))
    output = total([x * y, x - y, shifted(x, torch.tensor(3.0))])
    assert output.value == 2 * 5 + 2 - 5 + 3 + 2
    along = SimpleNamespace(x=torch.tensor([0.5]), y=torch.tensor([0.25]))
    expected = 0.5 * 5 + 2 * 0.25 + 0.5 - 0.25 + 0.5
    assert tape.push(output, (x, along.x.double()), (y, along.y.double())) == expected


def test_a_core_without_duals_is_differentiated_in_forward_mode():
    class Outside(nn.Module):
        def forward(self, x, t, r, context):
            return x.sin() * (t * r)[:, None, None]

    x, t, r, context = inputs()
    made = imf(parametrisation="velocity")
    cached = make_core("standard").condition(context)
    u, push = made.linearise(Outside(), x, r, t, cached, slice(None))
    torch.testing.assert_close(u, x.sin() * (t * r)[:, None, None])
    torch.testing.assert_close(push(x), (x * x.cos() * t[:, None, None] + x.sin()) * r[:, None, None])
