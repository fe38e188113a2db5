from dataclasses import replace

import torch
from tiny_policy import OPTIM, TinyPolicy
from torch import nn

from imfvla.training.optimiser import decayed_parameters, make_optimiser
from imfvla.training.spans import WHOLE


class Everything(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3, 3)
        self.conv = nn.Conv2d(3, 3, 1)
        self.norm = nn.LayerNorm(3)
        self.words = nn.EmbeddingBag(5, 3)
        self.query = nn.Parameter(torch.zeros(2, 3))
        self.step_identity = nn.Parameter(torch.zeros(2, 1, 3))
        self.output = nn.Parameter(torch.zeros(2, 3))
        self.gain = nn.Parameter(torch.ones(3))


def test_only_matrices_and_kernels_decay():
    assert decayed_parameters(Everything()) == {"linear.weight", "conv.weight", "output"}


def test_groups_hold_each_trainable_parameter_once():
    policy = Everything()
    policy.linear.requires_grad_(False)
    groups = make_optimiser(policy, OPTIM).param_groups
    held = [id(parameter) for group in groups for parameter in group["params"]]
    assert sorted(held) == sorted(id(p) for p in policy.parameters() if p.requires_grad)
    assert [group["weight_decay"] for group in groups] == [OPTIM.weight_decay, 0.0]


def test_decay_shrinks_what_has_no_gradient_signal():
    policy = TinyPolicy()
    optimiser = make_optimiser(policy, replace(OPTIM, weight_decay=0.5, lr=0.1))
    before = {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}
    for parameter in policy.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimiser.step()
    for name, parameter in policy.named_parameters():
        factor = 0.95 if name in ("net.0.weight", "net.3.weight") else 1.0
        torch.testing.assert_close(parameter.detach(), factor * before[name])


def test_parameters_that_learn_in_other_steps_have_groups_of_their_own():
    policy = nn.Linear(2, 2)
    groups = make_optimiser(policy, OPTIM, {"weight": (7, 9)}).param_groups
    assert [(group["span"], len(group["params"])) for group in groups] == [(WHOLE, 1), ((7, 9), 1)]
