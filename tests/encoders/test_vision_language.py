import pytest
import torch
from safetensors.torch import save_file

from imfvla.command.composition import compose
from imfvla.encoders.tokens import PatchTokens
from imfvla.encoders.vision_language import TextEncoder
from imfvla.errors import UserError
from imfvla.nn.pretrained import initialise_from_pretrained
from imfvla.options import build
from imfvla.policy import build_policy
from imfvla.training.optimiser import make_optimiser
from imfvla.training.options import OptimOptions
from imfvla.types import Batch, Observation, tokenize

SMALL = [
    "+exp=socket_smolvla",
    "observation.image_size=[32,32]",
    "size.depth=2",
    "size.width=20",
    "size.expert=15",
]


def policy(*overrides, seed=0):
    torch.manual_seed(seed)
    return build_policy(compose("train", [*SMALL, *overrides]))


def save(made, path):
    save_file({name: x.contiguous() for name, x in made.state_dict().items()}, path)


def sentences(*texts):
    return torch.stack([torch.from_numpy(tokenize(text)) for text in texts])


def test_a_patch_is_a_square_of_features_and_the_edge_is_padded():
    torch.manual_seed(0)
    tokens = PatchTokens(views=2, channels=3, grid=(3, 4), width=7, factor=2)
    assert tokens.tokens == 2 * 2
    x = torch.randn(5, 2, 3, 3, 4, requires_grad=True)
    seen = tokens(x)
    assert seen.shape == (5, 2 * 4, 7)
    normed = torch.nn.functional.layer_norm(x.flatten(3), (12,)).unflatten(3, (3, 4))
    patch = normed[0, 1, :, :2, 2:].flatten()  # upper right square of the second view
    torch.testing.assert_close(seen[0, 4 + 1], tokens.connector(patch) + tokens.identity[1, 1])
    lower = torch.cat((normed[0, 0, :, 2, :2], torch.zeros(3, 2)), 1).flatten()  # its lower row is not there
    torch.testing.assert_close(seen[0, 2], tokens.connector(lower) + tokens.identity[0, 2])


def test_words_see_each_other_and_not_the_empty_places():
    torch.manual_seed(0)
    text = TextEncoder(width=8, heads=2, depth=2, mlp_ratio=2.0).eval()
    short, other, empty = text(sentences("insert the peg", "lift the peg", ""))
    with torch.no_grad():
        text.positions[3:] += 9
    torch.testing.assert_close(text(sentences("insert the peg"))[0], short)
    assert not torch.allclose(short[2], other[2])  # "peg" knows its verb
    torch.testing.assert_close(short[3:], text.empty_token.expand(13, -1))
    torch.testing.assert_close(empty, text.empty_token.expand(16, -1))


def test_all_but_the_state_and_the_expert_come_from_the_checkpoint_of_another_policy(tmp_path):
    other, file = policy(seed=1), tmp_path / "backbone.safetensors"
    save(other, file)
    made = policy(f"core.pretrained={file}", "core.frozen=true")
    before = {name: x.clone() for name, x in made.state_dict().items()}
    initialise_from_pretrained(made)
    trained = {name for name, p in made.named_parameters() if p.requires_grad}
    assert {"encoder.state.weight", "core.input.weight", "core.output.weight"} <= trained
    frozen = {name for name, _ in made.named_parameters()} - trained
    assert {
        "encoder.vision.body.0.weight",
        "encoder.text.words.weight",
        "core.prefix_end.key_value.weight",
    } & frozen
    for name, parameter in made.named_parameters():
        assert torch.equal(parameter, (before if name in trained else other.state_dict())[name]), name


def test_what_is_frozen_has_no_gradient_no_optimiser_state_no_decay_and_is_in_eval_mode(tmp_path):
    file = tmp_path / "backbone.safetensors"
    save(policy(seed=1), file)
    made = policy(f"core.pretrained={file}", "core.frozen=true")
    initialise_from_pretrained(made)
    made.encoder.fit(-torch.ones(16), torch.ones(16))
    made.chunks.normaliser.fit(torch.zeros(32, 16), torch.ones(32, 16), 1.0)
    frozen = {name: p for name, p in made.named_parameters() if not p.requires_grad}
    before = {name: p.clone() for name, p in frozen.items()}
    optim = build(OptimOptions, compose("train", SMALL)["optim"] | {"lr": 0.1, "weight_decay": 0.5}, "optim")
    optimiser = make_optimiser(made, optim)

    made.train()
    parts = (made.encoder.vision, made.encoder.text.layers, made.core.prefix[0], made.core.prefix_end)
    assert not any(module.training for part in parts for module in part.modules())
    assert made.core.blocks[0].training
    assert made.encoder.state.training

    obs = Observation(
        torch.zeros(2, 1, 3, 3, 32, 32, dtype=torch.uint8), torch.rand(2, 1, 16), sentences("a", "b")
    )
    batch = Batch(obs, torch.rand(2, 32, 16), torch.ones(2, 32, dtype=torch.bool))
    torch.nn.init.normal_(made.core.output.weight)
    made.loss(batch, torch.Generator().manual_seed(0))[0].backward()
    optimiser.step()
    held = {id(p) for group in optimiser.param_groups for p in group["params"]}
    assert all(p.grad is None and id(p) not in held and p not in optimiser.state for p in frozen.values())
    assert all(torch.equal(before[name], p) for name, p in frozen.items())
    assert made.encoder.state.weight.grad.any()  # through the frozen prefix


def test_weights_of_another_size_are_refused_by_name(tmp_path):
    file = tmp_path / "other.safetensors"
    save(policy("size.width=10", "size.expert=10"), file)
    with pytest.raises(
        UserError, match=r"^(core|encoder)\.pretrained=.*does not fit this (core|encoder): ill-shaped"
    ):
        initialise_from_pretrained(policy(f"core.pretrained={file}"))


def test_nothing_to_freeze_is_refused():
    with pytest.raises(UserError, match=r"^encoder\.frozen=true needs encoder\.pretrained, found null: "):
        policy("core.frozen=true")
