"""The main job at toy size, simulator included: collect, train, stop, resume, evaluate, print the row."""

import json

import pytest

from imfvla.command.experiment import Trainer
from imfvla.storage.run_directory import DONE, FAILED, RunDirectory
from imfvla.train import main
from imfvla.training.logger import read_metrics


@pytest.mark.parametrize("task", ["socket", "transfer"])
def test_train_resume_evaluate(task, tmp_path, monkeypatch, capsys):
    command = [
        f"+exp={task}_ph32_exec16",
        "demos.episodes=1",
        "demos.camera_every=8",
        "demos.workers=0",
        "observation.image_size=[32,32]",
        "training.steps=4",
        "training.batch_size=4",
        "training.checkpoints=1",
        "training.log_every=1",
        "training.save_every_s=0",
        "training.threads=1",
        "evaluation.episodes=1",
        "evaluation.nfe=[1]",
        "evaluation.workers=0",
    ]
    monkeypatch.chdir(tmp_path)
    original = Trainer._update

    def stopped(trainer, batch):
        if trainer.step == 2:
            raise KeyboardInterrupt
        return original(trainer, batch)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_update", stopped)
        with pytest.raises(SystemExit) as exit_:
            main(command)
    assert exit_.value.code == 130
    (path,) = (tmp_path / "runs" / f"{task}_ph32_exec16").iterdir()
    run = RunDirectory(path)
    assert run.status()["state"] == FAILED

    main(command)
    assert run.status()["state"] == DONE
    assert [row["step"] for row in read_metrics(run.metrics)] == [1, 2, 3, 4]
    (evaluation,) = (run.path / "rollouts").iterdir()
    assert len((evaluation / "episodes.jsonl").read_text().splitlines()) == 1
    assert json.loads((evaluation / "summary.json").read_text())["episodes"] == 1
    assert "Success-like" in capsys.readouterr().out

    before = (evaluation / "episodes.jsonl").stat().st_mtime_ns
    main(command)
    assert (evaluation / "episodes.jsonl").stat().st_mtime_ns == before
    assert "is trained already" in (run.path / "train.log").read_text()
