import errno
import json

import pytest
import torch
from safetensors.torch import save_file
from tiny_policy import TinyPolicy

from imfvla.errors import UserError
from imfvla.storage.run_directory import RunDirectory
from imfvla.training import checkpoint, tensor_files, train_state
from imfvla.training.checkpoint import load_weights, save_weights
from imfvla.training.tensor_files import read_tensors


def test_weights_come_back_bit_for_bit(tmp_path):
    policy, other = TinyPolicy(), TinyPolicy()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.normal_()
    save_weights(tmp_path / "step-3", policy, {"step": 3})
    load_weights(other, tmp_path / "step-3" / "policy.safetensors")
    assert all(torch.equal(a, b) for a, b in zip(policy.parameters(), other.parameters(), strict=True))
    assert json.loads((tmp_path / "step-3" / "policy.json").read_text())["step"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["step-3"]


def test_channels_last_weights_are_kept(tmp_path):
    conv = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    save_weights(tmp_path / "step-1", conv, {})
    other = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    load_weights(other, tmp_path / "step-1" / "policy.safetensors")
    assert torch.equal(conv.weight, other.weight)
    assert other.weight.is_contiguous(memory_format=torch.channels_last)


def changed(name, tensor):
    tensors = dict(TinyPolicy().state_dict())
    if tensor is None:
        del tensors[name]
    else:
        tensors[name] = tensor
    return tensors


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        (changed("net.0.bias", None), r"missing net\.0\.bias"),
        (changed("core.alien", torch.zeros(2)), r"foreign core\.alien"),
        (changed("net.0.bias", torch.zeros(3)), r"net\.0\.bias has shape \(3,\), wanted \(16,\)"),
        (changed("scale", torch.zeros(2, dtype=torch.float64)), r"scale has type torch\.float64"),
    ],
)
def test_misfits_are_named_and_change_nothing(tmp_path, tensors, message):
    path = tmp_path / "policy.safetensors"
    save_file(tensors, path)
    policy = TinyPolicy()
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    with pytest.raises(UserError, match=message):
        load_weights(policy, path)
    assert all(torch.equal(before[name], tensor) for name, tensor in policy.state_dict().items())


def test_cut_off_file_is_named(tmp_path):
    save_weights(tmp_path / "step-1", TinyPolicy(), {})
    path = tmp_path / "step-1" / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UserError, match=r"policy\.safetensors is cut off or damaged"):
        read_tensors(path)
    with pytest.raises(UserError, match=r"absent\.safetensors is missing"):
        read_tensors(tmp_path / "absent.safetensors")


def test_weights_are_no_training_state(tmp_path, make_trainer):
    run = RunDirectory(tmp_path)
    save_weights(tmp_path / "step-1", TinyPolicy(), {})
    run.last_state.parent.mkdir(parents=True)
    (tmp_path / "step-1" / "policy.safetensors").rename(run.last_state)
    with pytest.raises(UserError, match="is not a training state"):
        make_trainer(tmp_path)


def test_state_of_another_policy_is_refused(tmp_path, make_trainer):
    class Wider(TinyPolicy):
        def __init__(self):
            super().__init__()
            self.net[0] = torch.nn.Linear(3, 17)
            self.net[3] = torch.nn.Linear(17, 8)

    make_trainer(tmp_path).train()
    with pytest.raises(UserError, match="does not fit the configured policy"):
        make_trainer(tmp_path, Wider())


class TestFullDisk:
    def fill_at(self, monkeypatch, nth):
        """The nth writing of tensors, counted from 1, finds the disk full after some bytes."""
        calls, original = [], tensor_files.write_tensors

        def write(path, tensors, header):
            calls.append(path)
            if len(calls) == nth:
                path.write_bytes(b"half")
                raise OSError(errno.ENOSPC, "No space left on device")
            original(path, tensors, header)

        for writer in (checkpoint, train_state):
            monkeypatch.setattr(writer, "write_tensors", write)

    def test_state_of_before_is_intact(self, tmp_path, make_trainer, monkeypatch):
        self.fill_at(monkeypatch, 2)
        trainer = make_trainer(tmp_path, checkpoints=1)
        with pytest.raises(
            UserError, match=r"Cannot write .*state\.safetensors: No space left.*free some space"
        ):
            trainer.train()
        assert make_trainer(tmp_path, checkpoints=1).step == 1
        assert not list(tmp_path.rglob("*.tmp"))

    def test_weights_appear_whole_or_not_at_all(self, tmp_path, make_trainer, monkeypatch):
        self.fill_at(monkeypatch, 2)  # the state of the same step goes before
        with pytest.raises(UserError, match=r"Cannot write .*step-1: No space left"):
            make_trainer(tmp_path, checkpoints=4).train()
        assert RunDirectory(tmp_path).weight_steps() == []
        assert not list(tmp_path.rglob("*.tmp"))

    def test_system_error_inside_safetensors_is_reported(self, tmp_path, monkeypatch):
        def fails(*_, **__):
            raise tensor_files.SafetensorError(
                'Error: I/O error: No space left on device (os error 28) at path "/a"'
            )

        monkeypatch.setattr(tensor_files, "save_file", fails)
        with pytest.raises(OSError, match="No space left") as caught:
            tensor_files.write_tensors(tmp_path / "x", {}, {})
        assert caught.value.errno == errno.ENOSPC


def test_run_without_weights_is_reported(tmp_path):
    with pytest.raises(UserError, match="has no weights"):
        RunDirectory(tmp_path).policy_weights()
    save_weights(RunDirectory(tmp_path).weights_directory(4), TinyPolicy(), {})
    with pytest.raises(UserError, match="no weights of step 5: kept are 4"):
        RunDirectory(tmp_path).policy_weights(5)
