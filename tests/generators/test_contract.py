"""What every configured generator promises: shapes, purity, padding that changes nothing, refusals by name."""

import pytest
import torch
from closed_forms import Context
from hydra.utils import instantiate
from torch import nn

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.errors import UserError
from imfvla.nn.act import ActCore
from imfvla.nn.residual import AttentionResidual
from imfvla.nn.transformer import TransformerCore

GENERATORS = sorted(path.stem for path in (CONFIG_DIRECTORY / "generator").glob("*.yaml"))
TIMES = sorted(path.stem for path in (CONFIG_DIRECTORY / "generator" / "times").glob("*.yaml"))
# The numbers of evaluations that a generator takes, where it does not take any.
TAKES = {"l1": (1,), "l2": (1,), "act": (1,), "imle": (1,), "two_step": (2,), "ddpm": range(1, 101)}
BATCH, STEPS, CHANNELS = 3, 4, 2

every_generator = pytest.mark.parametrize("name", GENERATORS)


def make(name, *overrides):
    return instantiate(compose("train", [f"generator={name}", *overrides])["generator"], _convert_="all")


def make_core(name="imf"):
    torch.manual_seed(0)
    if name == "act":
        return ActCore(
            steps=STEPS, channels=CHANNELS, width=8, heads=2, depth=1, decoder_depth=1, style_depth=1,
            style_width=3, state_token=-1, mlp_ratio=2.0, dropout=0.0,
        ).eval()  # fmt: skip
    core = TransformerCore(
        steps=STEPS,
        channels=CHANNELS,
        width=8,
        depth=1,
        heads=2,
        patch=2,
        mlp_ratio=2.0,
        max_rad=10.0,
        residual=lambda sublayers, width: AttentionResidual(sublayers, width, readout="sum"),
        velocity_head=make(name).core_interface == "flow and v-head",
    )
    for stack in (core, core.average) if core.average else (core,):
        nn.init.normal_(stack.output.weight, std=0.1)
    return core


def inputs():
    rng = torch.Generator().manual_seed(1)
    valid = torch.ones(BATCH, STEPS, dtype=torch.bool)
    valid[-1, 2:] = False
    return torch.randn(BATCH, 2, 8, generator=rng), torch.randn(BATCH, STEPS, CHANNELS, generator=rng), valid


def loss(generator, core, actions=None, seed=2):
    context, usual, valid = inputs()
    actions = usual if actions is None else actions
    return generator.loss(core, core.condition(context), actions, valid, torch.Generator().manual_seed(seed))


def sample(generator, core, noise, nfe):
    context, _, _ = inputs()
    with torch.inference_mode():
        return generator.sample(core, core.condition(context), noise, nfe)


@every_generator
def test_a_loss_for_each_chunk_that_reaches_every_weight(name):
    core = make_core(name)
    generator = make(name)
    for step in (0, 3):
        if hasattr(generator, "begin_step"):
            generator.begin_step(core, step, 4)  # its stages reach weights of their own
        value, logs = loss(generator, core)
        assert value.shape == (BATCH,)
        assert all(
            scalar.shape == () and scalar.isfinite() and not scalar.requires_grad for scalar in logs.values()
        )
        value.mean().backward()
    assert all(p.grad.isfinite().all() for p in core.parameters() if p.grad is not None)
    for stack in (core, getattr(core, "average", None) or core):
        assert stack.input.weight.grad is not None
        assert stack.output.weight.grad.abs().max() > 0


@every_generator
def test_the_loss_is_a_pure_function_of_its_arguments(name):
    core, generator = make_core(name), make(name)
    assert torch.equal(loss(generator, core)[0], loss(generator, core)[0])


@every_generator
def test_steps_that_are_not_valid_have_no_error_of_their_own(name):
    """A core that does not look at the actions tells the error of padded steps from what they show the network."""

    class Blind(nn.Module):
        def forward(self, *inputs):
            return torch.zeros(len(inputs[0]), STEPS, CHANNELS)

        def instant(self, *inputs):
            return self(*inputs)

        def style(self, context, actions, valid):
            return torch.zeros(2, BATCH, 3)

    _, actions, valid = inputs()
    garbage = actions.masked_fill(~valid.unsqueeze(-1), 100.0)
    generator = make(name)
    found, expected = (
        generator.loss(
            Blind(),
            torch.zeros(BATCH, 2, 8) if name == "act" else Context(),
            x,
            valid,
            torch.Generator().manual_seed(2),
        )[0]
        for x in (garbage, actions)
    )
    assert torch.equal(found, expected)


@every_generator
def test_the_sample_is_a_pure_function_of_its_noise(name):
    core, generator = make_core(name), make(name)
    noise = torch.randn(BATCH, STEPS, CHANNELS, generator=torch.Generator().manual_seed(3))
    for nfe in (n for n in (1, 2, 3, 100) if n in TAKES.get(name, (n,))):
        before = noise.clone()
        chunk = sample(generator, core, noise, nfe)
        torch.manual_seed(nfe)
        assert chunk.shape == noise.shape
        assert chunk.dtype == noise.dtype
        assert chunk.abs().max() <= generator.clip
        assert torch.equal(chunk, sample(generator, core, noise, nfe))
        assert torch.equal(noise, before)


@every_generator
@pytest.mark.parametrize("nfe", [1, 2, 100])
def test_sampling_calls_the_core_nfe_times(name, nfe):
    class Counted(nn.Module):
        calls = 0

        def forward(self, *inputs):
            self.calls += 1
            if name != "act":
                x, t, r, _ = inputs
                assert x.shape[:1] == t.shape == r.shape
                assert ((r >= 0) & (r <= t) & (t <= 1)).all()
            return torch.zeros(1, STEPS, CHANNELS)

        def instant(self, x, t, context):
            return self(x, t, t, context)

        style_width = 3

    core, generator = Counted(), make(name)
    if nfe not in TAKES.get(name, (nfe,)):
        with pytest.raises(UserError, match=f"must be {TAKES[name][0]} .*{name}.*found {nfe}"):
            generator.sample(core, None, torch.zeros(1, STEPS, CHANNELS), nfe)
    else:
        generator.sample(core, None, torch.zeros(1, STEPS, CHANNELS), nfe)
        assert core.calls == nfe


@every_generator
def test_an_impossible_nfe_is_refused(name):
    generator, impossible = make(name), [0, -1]
    if name in TAKES:
        impossible.append(TAKES[name][-1] + 1)
    for nfe in impossible:
        with pytest.raises(UserError, match=f"^nfe, .* must be .*[12].*, found {nfe}\\.$"):
            generator.check_nfe(nfe)
        with pytest.raises(UserError, match="nfe"):
            generator.sample(None, None, torch.zeros(1, STEPS, CHANNELS), nfe)


@pytest.mark.parametrize("times", TIMES)
def test_every_time_sampler_serves_every_generator_that_takes_one(times):
    for name in ("flow", "flow_high_noise", "meanflow"):
        generator = make(name, f"generator/times={times}")
        value, _ = loss(generator, make_core())
        assert value.isfinite().all()
        t = generator.times(4000, torch.Generator().manual_seed(0))
        assert t.shape == (4000,)
        assert ((t >= 0) & (t <= 1)).all()
        assert t.std() > 0.1
