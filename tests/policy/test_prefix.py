"""Policies that learn to go on from actions that are decided already."""

from dataclasses import replace

import pytest
import torch
from small_policy import batch, config, policy

from imfvla.errors import UserError
from imfvla.nn.forward_mode import jvp
from imfvla.policy.prefix import GivenContext, GivenCore, Known, PrefixInput, first_steps
from imfvla.training.parallel import rows

MOST = 3
HORIZON = {"obs": 1, "pred": 8, "exec": 4, "prefix_max": MOST}
REGRESSION = {"_target_": "imfvla.generators.regression.Regression", "power": 2, "clip": 5.0}
DIFFUSION = {
    "_target_": "imfvla.generators.ddpm.DenoisingDiffusion",
    "num_levels": 10,
    "prediction": "sample",
    "clip_sample": True,
    "draws": 2,
    "clip": 1.0,
}
IMLE = {
    "_target_": "imfvla.generators.imle.ImplicitMaximumLikelihood",
    "candidates": 3,
    "rejection": 0.01,
    "clip": 1.0,
}
ACT = {
    "generator": {"_target_": "imfvla.generators.act.ActionChunking", "kl_weight": 1.0, "clip": 1.0},
    "core": {
        "_target_": "imfvla.nn.act.ActCore",
        "steps": 8,
        "width": 16,
        "heads": 2,
        "depth": 1,
        "decoder_depth": 1,
        "style_depth": 1,
        "style_width": 4,
        "mlp_ratio": 2.0,
        "dropout": 0.0,
    },
}
STAGED = {
    "generator": {
        "_target_": "imfvla.generators.staged.StagedMeanFlow",
        "parametrisation": "data",
        "times": {"_target_": "imfvla.generators.base.UniformTimes"},
        "boundary_share": 1.0,
        "average_from": 0.5,
        "path_steps": 2,
        "velocity_head": True,
        "time_power": 2.0,
        "adaptive_power": 0.5,
        "adaptive_offset": 1e-3,
        "draws": 2,
        "clip": 1.0,
    },
    "core": config()["core"] | {"velocity_head": True},
}
METHODS = {
    "iMF in two stages": (STAGED, 2),
    "iMF": ({}, 1),
    "iMF in two steps": ({}, 2),
    "L2": ({"generator": REGRESSION}, 1),
    "DDIM": ({"generator": DIFFUSION}, 3),
    "IMLE": ({"generator": IMLE}, 1),
    "ACT": (ACT, 1),
}
every_method = pytest.mark.parametrize(("changes", "nfe"), METHODS.values(), ids=METHODS)


class Spy:
    """A generator that keeps what it is told."""

    core_interface = "flow"

    def loss(self, core, context, actions, valid, rng):
        self.told = core, context, actions, valid
        return actions.new_zeros(len(actions)), {}


def first(counts):
    return first_steps(torch.tensor(counts), 8)


def test_without_a_prefix_nothing_is_drawn_and_no_weights_are_added():
    plain, same = policy(), policy(horizon={**HORIZON, "prefix_max": 0})
    assert plain.state_dict().keys() == same.state_dict().keys()
    data = batch()
    context = plain.core.condition(plain.encoder(data.obs))
    rng = torch.Generator().manual_seed(1)
    expected, _ = plain.generator.loss(plain.core, context, plain.targets(data), data.valid, rng)
    assert torch.equal(same.loss(data, torch.Generator().manual_seed(1))[0], expected.mean())


def test_other_weights_begin_as_without_a_prefix():
    plain, with_prefix = policy().state_dict(), policy(horizon=HORIZON).state_dict()
    assert {name for name in with_prefix if name not in plain} == {
        f"prefix.given.{layer}.{kind}" for layer in (0, 2) for kind in ("weight", "bias")
    }
    del plain["core.output.weight"]  # drawn again by the test's policy
    assert all(torch.equal(tensor, with_prefix[name]) for name, tensor in plain.items())


def test_the_error_is_that_of_the_actions_that_are_not_given():
    made, data = policy(horizon=HORIZON), batch()
    made.generator = spy = Spy()
    counts = set()
    for seed in range(20):
        made.loss(data, torch.Generator().manual_seed(seed))
        _, context, actions, valid = spy.told
        given = context.given.squeeze(-1)
        counts |= set(given.sum(1).tolist())
        assert torch.equal(given, first(given.sum(1).tolist()))
        assert torch.equal(valid, data.valid & ~given)
        assert torch.equal(context.actions, actions)
    assert counts == set(range(MOST + 1))


def test_the_core_sees_given_actions_in_place_of_noise_at_any_time():
    made, data = policy(horizon=HORIZON), batch()
    made.generator = spy = Spy()
    made.loss(data, torch.Generator().manual_seed(0))
    core, context, actions, _ = spy.told
    rng = torch.Generator().manual_seed(3)
    noise, other = (torch.randn(actions.shape, generator=rng) for _ in range(2))
    t, r = torch.full((3,), 0.7), torch.full((3,), 0.2)
    mixed = torch.where(context.given, other, noise)
    with torch.no_grad():
        assert torch.equal(core(noise, t, r, context), core(mixed, t, r, context))
        assert not torch.equal(core(noise, t, r, context), core(other, t, r, context))
        twice = context.repeat(2)
        again = core(noise.repeat_interleave(2, 0), t.repeat_interleave(2), r.repeat_interleave(2), twice)
        torch.testing.assert_close(again[::2], core(noise, t, r, context))
        torch.testing.assert_close(
            core(noise[1:], t[1:], r[1:], context.rows(slice(1, None))), core(noise, t, r, context)[1:]
        )
    # The derivative of an average velocity is along the actions that move: a given one has no velocity.
    along = context.detach(torch.float32)
    tangents = [
        jvp(lambda z: core(z, t, r, along), (noise,), (v,))[1]
        for v in (other, torch.where(context.given, 0.0, other))
    ]
    torch.testing.assert_close(*tangents)


def test_what_is_given_reaches_the_core_through_its_context_too():
    prefix = PrefixInput(MOST, 2, 4)
    tokens, actions = torch.zeros(2, 3, 4), torch.ones(2, 8, 2)
    one, two = (prefix(tokens, actions, first([n, n])) for n in (1, 2))
    assert torch.equal(one[:, :-1], tokens[:, :-1])
    assert not torch.equal(one[:, -1], two[:, -1])
    changed = actions.clone()
    changed[:, 2:] = 9  # not given
    assert torch.equal(two, prefix(tokens, changed, first([2, 2])))


@every_method
def test_every_method_learns_and_writes_the_decided_actions_as_they_are(changes, nfe):
    made, data = policy(horizon=HORIZON, **changes), batch()
    made.loss(data, torch.Generator().manual_seed(1))[0].backward()
    assert made.prefix.given[0].weight.grad.abs().max() > 0
    going_on, noise = data.actions[0], torch.randn(3, 8, 16)
    with torch.inference_mode():
        free = made.eval().predict(data.obs, noise, nfe)
        for decided in (0, 1, MOST):
            chunk = made.predict(data.obs, noise, nfe, Known(going_on, decided))
            assert torch.equal(chunk[:, :decided], going_on[:decided].expand(3, -1, -1))
            assert chunk.isfinite().all()
            assert torch.equal(chunk, free) == (decided == 0)


def test_the_second_stage_follows_the_flow_from_what_is_given():
    made, data = policy(horizon=HORIZON, **STAGED), batch()
    made.begin_step(1, 2)
    torch.nn.init.normal_(made.core.average.output.weight, std=0.1)
    made.loss(data, torch.Generator().manual_seed(1))[0].backward()
    learned = {name for name, weights in made.named_parameters() if weights.grad is not None}
    assert learned
    assert all(name.startswith("core.average.") for name in learned)
    chunk = made.predict(data.obs, torch.randn(3, 8, 16), 1, Known(data.actions[0], 2)).detach()
    assert torch.equal(chunk[:, :2], data.actions[0, :2].expand(3, -1, -1))
    assert all(made.spans(2)[name] == (0, 1) for name, _ in made.prefix.named_parameters(prefix="prefix"))


def test_a_guided_chunk_has_the_decided_actions_and_comes_nearer_to_the_others():
    made, data = policy(), batch()
    going_on, noise = data.actions[0].clone(), torch.randn(3, 8, 16)
    weights = torch.tensor([1.0, 1.0, 0.8, 0.6, 0, 0, 0, 0])
    with torch.no_grad():
        free = made.predict(data.obs, noise, 3)
        chunk = made.predict(data.obs, noise, 3, Known(going_on, 2, weights))
    assert torch.equal(chunk[:, :2], going_on[:2].expand(3, -1, -1))
    assert (chunk[:, 2:4] - going_on[2:4]).square().sum() < (free[:, 2:4] - going_on[2:4]).square().sum()


@pytest.mark.parametrize(
    ("changes", "asked", "message"),
    [
        ({}, (2, 1, "trained"), r"prefix=trained needs a policy that was trained with horizon\.prefix_max"),
        ({}, (1, 1, "guided"), r"ImprovedMeanFlow with nfe=1 has none: take more steps .* prefix=trained"),
        ({"generator": REGRESSION}, (1, 1, "guided"), r"Regression with nfe=1 has none"),
        ({"generator": REGRESSION}, (1, 8, "none"), r"candidates must be 1 with Regression, found 8"),
        (ACT, (1, 2, "none"), r"candidates must be 1 with ActionChunking, found 2"),
    ],
)
def test_what_a_policy_cannot_do_is_refused_with_the_remedy(changes, asked, message):
    with pytest.raises(UserError, match=message):
        policy(**changes).check_replanning(*asked)


def test_what_a_policy_can_do_is_not_refused():
    policy(horizon=HORIZON).check_replanning(1, 8, "trained")
    policy(horizon=HORIZON, **ACT).check_replanning(1, 1, "trained")
    policy().check_replanning(2, 8, "guided")
    policy(generator=DIFFUSION).check_replanning(10, 1, "guided")


@pytest.mark.parametrize("most", [-1, 8, True, 1.5])
def test_a_prefix_that_is_no_part_of_the_chunk_is_refused(most):
    with pytest.raises(UserError, match=r"horizon\.prefix_max must be a whole number between 0 and 7"):
        policy(horizon={**HORIZON, "prefix_max": most})


def test_one_evaluation_learns_which_way_a_chunk_has_begun():
    """Chunks go one way or the other, and nothing but their first action says which: the mean is neither."""
    made, data = policy(horizon=HORIZON, generator=REGRESSION), batch(9)
    data = rows(data, torch.zeros(8, dtype=torch.int64))  # all see the same
    way = torch.tensor([1.0, -1.0]).repeat(4)[:, None, None]
    up = torch.ones(8, 8, 16)
    actions = made.chunks.denormalise(way * up, data.obs.state[:, -1])
    data = replace(data, actions=actions)
    optimiser, rng = torch.optim.AdamW(made.parameters(), 0.01), torch.Generator().manual_seed(0)
    for _ in range(120):
        optimiser.zero_grad()
        made.loss(data, rng)[0].backward()
        optimiser.step()
    with torch.inference_mode():
        noise, state = torch.zeros(8, 8, 16), data.obs.state[:, -1]
        free, *ways = (
            made.chunks.normalise(made.eval().predict(data.obs, noise, 1, known), state).mean(dim=(1, 2))
            for known in (None, *(Known(actions[row], 1) for row in (0, 1)))
        )
    assert free.abs().max() < 0.4
    assert ways[0].min() > 0.7
    assert ways[1].max() < -0.7


def test_a_core_with_a_head_for_the_instantaneous_velocity_sees_the_same():
    class Core:
        def instant(self, x, t, context):
            return x

    given = first([2, 0]).unsqueeze(-1)
    context = GivenContext(None, torch.ones(2, 8, 1), given)
    seen = GivenCore(Core()).instant(torch.zeros(2, 8, 1), None, context)
    assert torch.equal(seen, given.float())
