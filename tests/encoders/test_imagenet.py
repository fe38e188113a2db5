"""torchvision's ImageNet weights in our ResNet18, from files that are made here."""

import pytest
import torch
from safetensors.torch import save_file

from imfvla.encoders.imagenet import KEY
from imfvla.encoders.vision import ResNet18
from imfvla.errors import UserError

WIDTHS = {1: (64, 64), 2: (64, 128), 3: (128, 256), 4: (256, 512)}
BLOCK = {"conv1": "body.0", "bn1": "body.1", "conv2": "body.3", "bn2": "body.4"}


def batch_norm(name, channels):
    return {
        **{f"{name}.{part}": torch.randn(channels) for part in ("weight", "bias", "running_mean")},
        f"{name}.running_var": torch.rand(channels),
        f"{name}.num_batches_tracked": torch.tensor(7),
    }


@pytest.fixture(scope="module")
def state_dict():
    """Random weights under the 122 names of torchvision.models.resnet18."""
    torch.manual_seed(0)
    state = {"conv1.weight": torch.randn(64, 3, 7, 7), **batch_norm("bn1", 64)}
    for layer, (inputs, outputs) in WIDTHS.items():
        for block in (0, 1):
            name, seen = f"layer{layer}.{block}", outputs if block else inputs
            state[f"{name}.conv1.weight"] = torch.randn(outputs, seen, 3, 3)
            state[f"{name}.conv2.weight"] = torch.randn(outputs, outputs, 3, 3)
            state |= batch_norm(f"{name}.bn1", outputs) | batch_norm(f"{name}.bn2", outputs)
            if seen != outputs:
                state[f"{name}.downsample.0.weight"] = torch.randn(outputs, seen, 1, 1)
                state |= batch_norm(f"{name}.downsample.1", outputs)
    return state | {"fc.weight": torch.randn(1000, 512), "fc.bias": torch.randn(1000)}


def counterpart(name):
    """Our name of torchvision's parameter."""
    if name.startswith(("conv1.", "bn1.")):
        return name.replace("conv1", "stem.0").replace("bn1", "stem.1")
    layer, block, part, *rest = name.split(".")
    part = BLOCK.get(part, "shortcut")
    return ".".join((f"stages.{int(layer[-1]) - 1}.{block}.{part}", *rest))


@pytest.mark.parametrize("residual", ["standard", "attention"])
def test_every_convolution_and_every_norm_is_taken_by_its_key(residual, state_dict, tmp_path):
    path = tmp_path / "resnet18.safetensors"
    save_file(state_dict, path)
    assert len(state_dict) == 122
    trunk = ResNet18(residual, str(path))
    trunk.initialise_from_pretrained()
    taken = dict(trunk.named_parameters())
    queries = [taken.pop(name) for name in list(taken) if name.endswith("query")]
    for name, wanted in state_dict.items():
        if not name.startswith("fc.") and name.endswith(("weight", "bias")):
            assert torch.equal(taken.pop(counterpart(name)), wanted), name
    assert not taken
    assert len(queries) == (4 if residual == "attention" else 0)


def test_pictures_are_standardised_as_those_that_imagenet_s_weights_saw():
    trunk, seen = ResNet18(), []
    trunk.stem.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    pixels = torch.rand(1, 3, 32, 32)
    trunk(2 * pixels - 1)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    torch.testing.assert_close(seen[0], (pixels - mean[:, None, None]) / std[:, None, None])


def test_misfits_are_told_together_and_change_nothing(state_dict, tmp_path):
    state = {name: tensor for name, tensor in state_dict.items() if not name.startswith("layer4.1.conv")}
    state |= {"conv1.weight": torch.randn(64, 1, 7, 7), "layer1.2.conv1.weight": torch.randn(1)}
    path = tmp_path / "other.safetensors"
    save_file(state, path)
    trunk = ResNet18(pretrained=str(path))
    before = {name: tensor.clone() for name, tensor in trunk.state_dict().items()}
    with pytest.raises(UserError) as raised:
        trunk.initialise_from_pretrained()
    assert str(raised.value) == (
        f"{KEY}={path} is not torchvision's resnet18: missing layer4.1.conv1.weight, layer4.1.conv2.weight; "
        "foreign layer1.2.conv1.weight; ill-shaped conv1.weight (64, 1, 7, 7) for (64, 3, 7, 7)."
    )
    assert all(torch.equal(before[name], tensor) for name, tensor in trunk.state_dict().items())


@pytest.mark.parametrize("pretrained", [None, "gone.safetensors"])
def test_building_and_loading_a_checkpoint_read_no_file(pretrained):
    made = ResNet18(pretrained=pretrained)
    made.load_state_dict(ResNet18().state_dict())
    if pretrained is None:
        made.initialise_from_pretrained()
