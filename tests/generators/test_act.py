"""ACT's objective: the divergence's closed form, style zero in rollouts, and that it learns."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from imfvla.generators.act import ActionChunking, divergence_from_standard_normal
from imfvla.nn.act import ActCore


def make_core() -> ActCore:
    torch.manual_seed(0)
    return ActCore(
        steps=4, channels=2, width=16, heads=2, depth=1, decoder_depth=1, style_depth=1, style_width=3,
        state_token=-1, mlp_ratio=2.0, dropout=0.0,
    )  # fmt: skip


def test_divergence_is_that_of_the_two_normal_distributions():
    rng = torch.Generator().manual_seed(0)
    mean, log_variance = torch.randn(2, 5, 3, generator=rng)
    expected = kl_divergence(Normal(mean, (0.5 * log_variance).exp()), Normal(0.0, 1.0)).sum(-1)
    torch.testing.assert_close(divergence_from_standard_normal(mean, log_variance), expected)
    assert (divergence_from_standard_normal(torch.zeros(2, 3), torch.zeros(2, 3)) == 0).all()


def test_the_divergence_enters_with_its_weight():
    core, context, actions = make_core(), torch.randn(3, 2, 16), torch.randn(3, 4, 2)
    valid = torch.ones(3, 4, dtype=torch.bool)

    def loss(kl_weight: float) -> torch.Tensor:
        generator = ActionChunking(kl_weight=kl_weight, clip=10.0)
        return generator.loss(core, context, actions, valid, torch.Generator().manual_seed(0))[0]

    mean, log_variance = core.style(context, actions, valid)
    divergence = divergence_from_standard_normal(mean, log_variance)
    torch.testing.assert_close(loss(7.0) - loss(0.0), 7.0 * divergence)


def test_the_divergence_is_not_computed_in_bf16():
    core, context, actions = make_core(), torch.zeros(3, 2, 16), torch.randn(3, 4, 2)
    with torch.no_grad():  # variances near one, where bf16 has too few digits for the difference
        core.style_output.weight.zero_()
        core.style_output.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.03, -0.05, 0.07]))
    valid = torch.ones(3, 4, dtype=torch.bool)
    with torch.autocast("cpu", torch.bfloat16):
        _, logs = ActionChunking(kl_weight=10.0, clip=10.0).loss(
            core, context, actions, valid, torch.Generator()
        )
    bias = core.style_output.bias.to(torch.bfloat16).float()
    torch.testing.assert_close(logs["divergence"], divergence_from_standard_normal(bias[:3], bias[3:]))
    assert logs["divergence"] > 0


def test_a_rollout_takes_style_zero():
    core, generator, context = make_core(), ActionChunking(kl_weight=10.0, clip=10.0), torch.randn(3, 2, 16)
    chunks = [generator.sample(core, context, torch.randn(3, 4, 2), nfe=1) for _ in range(2)]
    assert torch.equal(*chunks)
    assert torch.equal(chunks[0], core(context, torch.zeros(3, 3)))


def test_learns_one_batch():
    core, generator = make_core(), ActionChunking(kl_weight=0.01, clip=10.0)
    rng = torch.Generator().manual_seed(0)
    context, actions = torch.randn(8, 2, 16, generator=rng), torch.randn(8, 4, 2, generator=rng)
    valid = torch.ones(8, 4, dtype=torch.bool)
    optimiser = torch.optim.AdamW(core.parameters(), lr=3e-3)
    for _ in range(150):
        loss, _ = generator.loss(core, context, actions, valid, rng)
        optimiser.zero_grad()
        loss.mean().backward()
        optimiser.step()
    error = (generator.sample(core, context, torch.zeros(8, 4, 2), 1) - actions).abs().mean()
    assert error < 0.25 * actions.abs().mean()


@pytest.mark.parametrize(("kl_weight", "lives"), [(10.0, False), (0.01, True)])
def test_a_latent_lives_only_where_its_weight_is_small_against_the_error(kl_weight, lives):
    """Chunks of all zeros or all ones, half each, from one context: a style can say which, in ln 2 nats.

    That saves half of an action's deviation, a great deal more than the committed error of 0.19 has to give.
    """
    torch.manual_seed(0)
    core, generator = make_core(), ActionChunking(kl_weight=kl_weight, clip=10.0)
    rng = torch.Generator().manual_seed(0)
    context, valid = torch.zeros(32, 2, 16), torch.ones(32, 4, dtype=torch.bool)
    actions = (torch.arange(32) % 2).float().reshape(-1, 1, 1).expand(-1, 4, 2)
    optimiser = torch.optim.Adam(core.parameters(), lr=5e-3)
    for _ in range(150):
        value, logs = generator.loss(core, context, actions, valid, rng)
        optimiser.zero_grad()
        value.mean().backward()
        optimiser.step()
    if lives:
        assert logs["divergence"] > 0.69
        assert logs["absolute_error"] < 0.1
    else:
        assert logs["divergence"] < 0.01
        assert logs["absolute_error"] > 0.4
