import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from imfvla.errors import UserError
from imfvla.nn.pretrained import initialise_from_pretrained, read_weights, take_weights


class Part(nn.Linear):
    def initialise_from_pretrained(self):
        nn.init.ones_(self.weight)


def test_every_part_that_can_takes_its_weights():
    model = nn.Sequential(nn.Linear(2, 2), nn.Sequential(Part(2, 2)))
    before = model[0].weight.clone()
    initialise_from_pretrained(model)
    assert torch.equal(model[1][0].weight, torch.ones(2, 2))
    assert torch.equal(model[0].weight, before)


def test_weights_are_read_as_they_were_written(tmp_path):
    weights = {"a": torch.randn(2, 3), "b": torch.arange(3)}
    save_file(weights, tmp_path / "x.safetensors")
    found = read_weights(tmp_path / "x.safetensors", "encoder.weights")
    assert found.keys() == weights.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in weights.items())


def test_a_pickle_is_refused_with_the_way_to_convert_it(tmp_path):
    torch.save({}, tmp_path / "x.pth")
    convert = r"torch\.load\('x\.pth', weights_only=True\), 'x\.safetensors'\)"
    with pytest.raises(UserError, match=rf"encoder\.weights must be null .*x\.pth': convert .*{convert}"):
        read_weights(tmp_path / "x.pth", "encoder.weights")


def test_a_missing_and_a_broken_file_are_named(tmp_path):
    path = tmp_path / "x.safetensors"
    with pytest.raises(UserError, match=r"encoder\.weights names .*x\.safetensors, which is not there"):
        read_weights(path, "encoder.weights")
    torch.save({"a": torch.zeros(2)}, path)
    with pytest.raises(UserError, match=r"x\.safetensors, which cannot be read as safetensors"):
        read_weights(path, "encoder.weights")


def test_long_lists_of_misfits_are_cut():
    wanted = {f"p{index}": torch.zeros(1) for index in range(7)}
    with pytest.raises(UserError, match=r"^the file: missing p0, p1, p2, p3 and 3 more; foreign q\.$"):
        take_weights(wanted, {"q": torch.zeros(1), "r": torch.zeros(1)}, {"r"}, "the file")
