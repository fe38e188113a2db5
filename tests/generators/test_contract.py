"""What every configured generator promises: shapes, purity, padding that changes nothing, refusals by name."""

from functools import cache, partial

import pytest
import torch
from closed_forms import Context
from hydra.utils import instantiate
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.errors import UserError
from imfvla.generators.base import HasStages, draws_noise, uses_noise
from imfvla.nn.act import ActCore
from imfvla.nn.residual import AttentionResidual
from imfvla.nn.transformer import TransformerCore

GENERATORS = sorted(path.stem for path in (CONFIG_DIRECTORY / "generator").glob("*.yaml"))
TIMES = sorted(path.stem for path in (CONFIG_DIRECTORY / "generator" / "times").glob("*.yaml"))
NFES = (1, 2, 3, 100)  # numbers of evaluations to try
BATCH, STEPS, CHANNELS = 3, 4, 2

every_generator = pytest.mark.parametrize("name", GENERATORS)


def make(name, *overrides):
    return instantiate(compose("train", [f"generator={name}", *overrides])["generator"], _convert_="all")


@cache
def interface(name):
    return make(name).core_interface


def takes(generator, nfe):
    """Whether a generator samples in so many evaluations."""
    try:
        generator.check_nfe(nfe)
    except UserError:
        return False
    return True


def make_core(name):
    torch.manual_seed(0)
    if interface(name) == "style":
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
        velocity_head=interface(name) == "flow and v-head",
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
        if isinstance(generator, HasStages):
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
            torch.zeros(BATCH, 2, 8) if interface(name) == "style" else Context(),
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
    for nfe in filter(partial(takes, generator), NFES):
        before = noise.clone()
        chunk = sample(generator, core, noise, nfe)
        torch.manual_seed(nfe)
        assert chunk.shape == noise.shape
        assert chunk.dtype == noise.dtype
        assert chunk.abs().max() <= generator.clip
        assert torch.equal(chunk, sample(generator, core, noise, nfe))
        assert torch.equal(noise, before)
        assert torch.equal(chunk, sample(generator, core, -noise, nfe)) != uses_noise(generator)


@every_generator
@pytest.mark.parametrize("nfe", [1, 2, 100])
def test_sampling_calls_the_core_nfe_times(name, nfe):
    class Counted(nn.Module):
        calls = 0

        def forward(self, *inputs):
            self.calls += 1
            if interface(name) != "style":
                x, t, r, _ = inputs
                assert x.shape[:1] == t.shape == r.shape
                assert ((r >= 0) & (r <= t) & (t <= 1)).all()
            return torch.zeros(1, STEPS, CHANNELS)

        def instant(self, x, t, context):
            return self(x, t, t, context)

        style_width = 3

    core, generator = Counted(), make(name)
    if not takes(generator, nfe):
        with pytest.raises(UserError, match=f"must be .*found {nfe}"):
            generator.sample(core, None, torch.zeros(1, STEPS, CHANNELS), nfe)
    else:
        generator.sample(core, None, torch.zeros(1, STEPS, CHANNELS), nfe)
        assert core.calls == nfe


@every_generator
def test_an_impossible_nfe_is_refused(name):
    generator = make(name)
    assert any(takes(generator, nfe) for nfe in NFES)
    for nfe in (0, -1, *(nfe for nfe in (1, 2, 3, 101) if not takes(generator, nfe))):
        with pytest.raises(UserError, match=f"^nfe, .* must be .*[1-9].*, found {nfe}\\.$"):
            generator.check_nfe(nfe)
        with pytest.raises(UserError, match="nfe"):
            generator.sample(None, None, torch.zeros(1, STEPS, CHANNELS), nfe)


class Draws(TorchDispatchMode):
    """Counts the operations that draw random numbers, save those that drop units out, which have their own switch."""

    count = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        is_random = torch.Tag.nondeterministic_seeded in operation.tags
        self.count += is_random and "dropout" not in str(operation._schema)
        return operation(*args, **(kwargs or {}))


@every_generator
def test_what_is_drawn_besides_the_initial_noise_is_told(name):
    """Where `draws_noise` is false, a chunk from zeros depends on the observation alone."""
    core, generator = make_core(name), make(name)
    context, _, _ = inputs()
    for nfe in filter(partial(takes, generator), NFES):
        draws = Draws()
        with torch.inference_mode(), draws:
            generator.sample(core, core.condition(context), torch.zeros(BATCH, STEPS, CHANNELS), nfe)
        assert bool(draws.count) == draws_noise(generator, nfe), f"{name}, nfe {nfe}: {draws.count} draws"


@pytest.mark.parametrize("times", TIMES)
def test_every_time_sampler_serves_every_generator_that_takes_one(times):
    sampler = make("flow", f"generator/times={times}").times
    t = sampler(4000, torch.Generator().manual_seed(0))
    assert t.shape == (4000,)
    assert ((t >= 0) & (t <= 1)).all()
    assert t.std() > 0.1
    for name, generator in takers_of_times().items():
        generator.times = sampler
        value, _ = loss(generator, make_core(name))
        assert value.isfinite().all()


@cache
def takers_of_times():
    made = {name: make(name) for name in GENERATORS}
    return {name: generator for name, generator in made.items() if hasattr(generator, "times")}
