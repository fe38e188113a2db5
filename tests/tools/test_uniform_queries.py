"""tools/depth_attention.py --uniform: the same policy with queries of zero."""

import sys

import pytest
import torch
from test_hostile_files import load_tool
from untrained_run import STEPS, untrained_run

from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy, save_weights


def run_tool(monkeypatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["depth_attention.py", *arguments])
    return load_tool("depth_attention").main()


def test_a_policy_with_uniform_weights_differs_in_its_queries_alone(tmp_path, monkeypatch):
    run, target = untrained_run(tmp_path / "run"), tmp_path / "uniform"
    policy = load_policy(run)
    torch.nn.init.normal_(policy.core.residual.query)
    save_weights(run.weights_directory(STEPS), policy, {"step": STEPS})
    assert run_tool(monkeypatch, str(run.path), "--uniform", str(target)) == 0
    before, after = policy.state_dict(), load_policy(RunDirectory(target)).state_dict()
    changed = {name for name, tensor in after.items() if not torch.equal(tensor, before[name])}
    assert changed == {"core.residual.query"}
    assert not after["core.residual.query"].any()


@pytest.mark.parametrize(
    ("overrides", "target", "message"),
    [
        (["core=standard"], "new", "must be Attention Residuals, found StandardResidual"),
        ([], "run", "exists already: choose a new folder"),
    ],
)
def test_what_cannot_be_written_is_told(tmp_path, monkeypatch, capsys, overrides, target, message):
    run = untrained_run(tmp_path / "run", *overrides)
    assert run_tool(monkeypatch, str(run.path), "--uniform", str(tmp_path / target)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
