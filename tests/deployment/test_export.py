"""python -m imfvla.export, from a run directory to graphs and cards."""

import json

import pytest
from untrained_run import untrained_run

from imfvla.deployment import exporting, parity
from imfvla.errors import UserError
from imfvla.export import main

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")


def refused(*arguments, capsys):
    with pytest.raises(SystemExit) as exit:
        main(list(arguments))
    assert exit.value.code == 2
    return capsys.readouterr().err


def test_graphs_and_a_card_are_written_beside_the_weights(tmp_path, capsys):
    run = untrained_run(tmp_path / "run")
    main([f"run={run.path}", "nfe=1", "observations=2", "calls=2"])
    assert "as ONNX" in capsys.readouterr().out
    folder = run.path / "onnx"
    assert {path.name for path in folder.iterdir()} == {"infer1.onnx", "infer1.json"}
    card = json.loads((folder / "infer1.json").read_text())
    assert card["parity"]["observations"] == 2
    assert card["parity"]["largest_difference"] <= 1e-5
    session = onnxruntime.InferenceSession(folder / "infer1.onnx")
    shapes = {node.name: node.shape for node in session.get_inputs()}
    assert shapes == {name: entry["shape"] for name, entry in card["inputs"].items()}
    assert "exists already" in refused(f"run={run.path}", capsys=capsys)


def test_a_graph_that_differs_is_not_written(tmp_path, capsys, monkeypatch):
    run = untrained_run(tmp_path / "run", "generator=l1")
    monkeypatch.setattr(parity, "TOLERANCE", -1.0)
    monkeypatch.setattr(exporting, "policy_graphs", lambda policy, nfe: {})
    monkeypatch.setattr(exporting, "OnnxPolicy", lambda policy, nfe, graphs: policy)
    assert "differ from the policy by 0: wanted at most -1" in refused(
        f"run={run.path}", "nfe=1", "observations=2", capsys=capsys
    )
    assert not (run.path / "onnx").exists()


def test_a_folder_that_another_process_makes_meanwhile_stays(tmp_path):
    folder = tmp_path / "onnx"
    folder.mkdir()
    with pytest.raises(UserError, match="onnx exists already: remove it"):
        exporting.write_folder(folder, {"infer1.onnx": b"graph"}, {"infer1.json": {}})
    assert [path.name for path in tmp_path.iterdir()] == ["onnx"]
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "export needs the directory of a training run"),
        (["run=nowhere"], "is not a run directory"),
        (["run={run}", "nfe=0"], "nfe must be one or more whole numbers"),
        (["run={run}", "nfe=2"], "must be 1 with generator=l1"),
        (["run={run}", "observations=0"], "observations must be"),
    ],
)
def test_a_mistake_is_told_before_anything_is_exported(tmp_path, capsys, arguments, words):
    run = untrained_run(tmp_path / "run", "generator=l1")
    assert words in refused(*(text.format(run=run.path) for text in arguments), capsys=capsys)
    assert {path.name for path in run.path.iterdir()} == {"config.yaml", "checkpoints"}
