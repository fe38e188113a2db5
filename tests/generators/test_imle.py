import pytest
import torch
from closed_forms import CHANNELS, STEPS, Context, draw
from torch import nn

from imfvla.generators.imle import ImplicitMaximumLikelihood


def generator(**changes) -> ImplicitMaximumLikelihood:
    options = {"candidates": 4, "rejection": 0.0, "clip": 10.0}
    return ImplicitMaximumLikelihood(**(options | changes))


class Scaled(nn.Module):
    """The noise times a learned scale, and how often it was asked for a gradient."""

    def __init__(self, scale=1.0):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(scale, dtype=torch.float64))
        self.rows_with_gradient = 0

    def forward(self, x, t, r, context):
        assert (t == 1).all()
        assert (r == 0).all()
        if torch.is_grad_enabled():
            self.rows_with_gradient += len(x)
        return self.scale * x


def loss_of(core, actions, seed=0, valid=None, **changes):
    valid = torch.ones(len(actions), STEPS, dtype=torch.bool) if valid is None else valid
    return generator(**changes).loss(core, Context(), actions, valid, torch.Generator().manual_seed(seed))


def candidates(count, each=4, seed=0):
    """The noises that the loss draws, (count, each, H, A)."""
    rng = torch.Generator().manual_seed(seed)
    noise = torch.randn(count * each, STEPS, CHANNELS, generator=rng)
    return noise.double().unflatten(0, (count, each))


def test_the_loss_is_the_distance_of_the_nearest_candidate_and_only_that_one_learns():
    core, actions = Scaled(), draw(5)[0]
    loss, logs = loss_of(core, actions)
    found = (candidates(5) - actions[:, None]).square().mean((2, 3)).sqrt()
    torch.testing.assert_close(loss, found.min(dim=1).values)
    torch.testing.assert_close(logs["mean_distance"], found.mean())
    assert core.rows_with_gradient == 5
    loss.sum().backward()
    near = candidates(5)[torch.arange(5), found.argmin(dim=1)]
    error = near - actions
    slope = ((error * near).mean((1, 2)) / error.square().mean((1, 2)).sqrt()).sum()
    torch.testing.assert_close(core.scale.grad, slope)


def test_candidates_that_are_near_enough_are_left_alone():
    noise = candidates(2)
    actions = torch.stack((noise[0, 1] + 0.01, noise[1].mean(0)))
    far = (noise - actions[:, None]).square().mean((2, 3)).sqrt()
    assert far[0].argmin() == 1
    loss, logs = loss_of(Scaled(), actions, rejection=0.05)
    others = far[0, [0, 2, 3]].min()
    torch.testing.assert_close(loss, torch.stack((others, far[1].min())))
    assert logs["rejected"] == pytest.approx(1 / 8)
    torch.testing.assert_close(logs["nearest_distance"], far.min(dim=1).values.mean())


def test_a_chunk_all_of_whose_candidates_are_near_enough_has_no_loss_and_a_finite_gradient():
    core, actions = Scaled(), draw(3)[0]
    loss, _ = loss_of(core, actions, rejection=1e6)
    assert not loss.any()
    loss.sum().backward()
    assert core.scale.grad == 0
    exact = candidates(1, each=1)[:, 0]
    loss, _ = loss_of(core, exact, candidates=1)
    loss.sum().backward()
    assert core.scale.grad.isfinite()


def test_invalid_steps_do_not_choose():
    noise = candidates(1)
    valid = torch.ones(1, STEPS, dtype=torch.bool)
    valid[0, 1:] = False
    actions = noise[:, 2].clone()
    actions[0, 1:] = noise[0, 0, 1:]
    loss, _ = loss_of(Scaled(), actions, valid=valid)
    assert loss.item() == pytest.approx(0, abs=1e-5)


class TwoAnswers(nn.Module):
    """A chunk that is one of two learned ones, by the sign of the noise's first number."""

    def __init__(self):
        super().__init__()
        self.answers = nn.Parameter(0.1 * torch.tensor([[1.0], [-1.0]], dtype=torch.float64))

    def forward(self, x, t, r, context):
        which = (x[:, 0, 0] < 0).long()
        return self.answers[which].unsqueeze(-1).expand_as(x)


def test_both_ways_of_doing_it_are_learned_and_neither_is_their_average():
    core = TwoAnswers()
    optimiser = torch.optim.SGD(core.parameters(), 0.05)
    actions = torch.ones(32, STEPS, CHANNELS, dtype=torch.float64)
    actions[:16] = -1
    for step in range(200):
        optimiser.zero_grad()
        loss_of(core, actions, seed=step, candidates=6, rejection=0.05)[0].mean().backward()
        optimiser.step()
    torch.testing.assert_close(
        core.answers.detach().flatten().abs(), torch.ones(2).double(), atol=0.08, rtol=0
    )
    assert core.answers.prod() < 0


def test_a_sample_is_the_core_s_answer_to_the_noise_clamped():
    noise = draw(4)[0]
    torch.testing.assert_close(
        generator(clip=1.0).sample(Scaled(2.0), None, noise, 1), (2 * noise).clamp(-1, 1)
    )
