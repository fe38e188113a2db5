"""Rollouts with the exported graphs: evaluation.runtime=onnx."""

import importlib.util
import json

import pytest
import torch
from untrained_run import STEPS, untrained_run

from imfvla import evaluate as entry
from imfvla.config.protocol import EvaluationOptions
from imfvla.deployment.ready import check_runtime
from imfvla.errors import UserError
from imfvla.rollouts.evaluation import evaluate
from imfvla.training.checkpoint import load_policy, save_weights

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")
FEW = {"episodes": 2, "first_seed": 0, "workers": 0, "max_steps": 6, "recordings": False, "nfe": (1,)}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Evaluated once with the command, which exports."""
    made = untrained_run(tmp_path_factory.mktemp("onnx") / "run", "generator=l1")
    entry.main(
        [
            f"run={made.path}",
            "runtime=onnx",
            *(f"{key}={value}" for key, value in FEW.items() if key != "nfe"),
            "nfe=1",
        ]
    )
    return made


def rows(run, name):
    return [json.loads(line) for line in (run.rollouts(name) / "episodes.jsonl").read_text().splitlines()]


def test_graphs_are_exported_and_play_the_episodes_of_the_policy(run):
    assert (run.path / "onnx" / "infer1.json").exists()
    (summary,) = evaluate(run, EvaluationOptions(**FEW))
    assert summary["protocol"]["runtime"] == "eager"
    played, exported = rows(run, "seeds0-1_nfe1_max6"), rows(run, "seeds0-1_nfe1_max6_onnx")
    for one, other in zip(played, exported, strict=True):
        assert one["start_digest"] == other["start_digest"]
        assert one["total_reward"] == pytest.approx(other["total_reward"], abs=1e-4)


def test_the_protocol_says_the_runtime(run):
    summary = json.loads((run.rollouts("seeds0-1_nfe1_max6_onnx") / "summary.json").read_text())
    assert summary["protocol"]["runtime"] == "onnx"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"candidates": 4}, "candidates must be 1 with runtime=onnx"),
        ({"device": "cuda"}, "device must be cpu with runtime=onnx"),
        ({"runtime": "tensorrt"}, "runtime must be"),
    ],
)
def test_what_graphs_cannot_do_is_refused(options, words):
    from imfvla.options import build

    with pytest.raises(UserError, match=words):
        build(EvaluationOptions, {"runtime": "onnx", **FEW, "nfe": [1], **options}, "")


def test_another_number_of_evaluations_is_refused(run):
    with pytest.raises(UserError, match=r"has no graphs of nfe=2, .*: remove .*onnx, and evaluate again"):
        evaluate(run, EvaluationOptions(**FEW | {"nfe": (2,)}, runtime="onnx"))


def test_a_changed_graph_is_refused(run):
    path = run.path / "onnx" / "infer1.onnx"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(UserError, match=r"infer1.onnx has the digest \w+, its card says \w+"):
        evaluate(run, EvaluationOptions(**FEW, runtime="onnx", overwrite=True))
    path.write_bytes(content)


def test_graphs_of_other_weights_are_refused(run):
    policy = load_policy(run, STEPS)
    with torch.no_grad():
        next(policy.core.parameters()).add_(1)
    save_weights(run.weights_directory(STEPS + 1), policy, {"step": STEPS + 1})
    with pytest.raises(UserError, match=r"was exported from weights .*, wanted those of step 6"):
        evaluate(run, EvaluationOptions(**FEW, runtime="onnx"))


def test_a_missing_package_is_named_with_its_extra(run, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        UserError, match=r"runtime=onnx needs onnx, onnxscript, onnxruntime: pip install .*\[onnx\]"
    ):
        check_runtime(run.config(), EvaluationOptions(**FEW, runtime="onnx"))
