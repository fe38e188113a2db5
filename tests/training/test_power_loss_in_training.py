"""A training, and a loss of power at every moment: a whole state, and every row of metrics before it."""

import json

from losing_disk import watch

from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import read_metrics
from imfvla.training.tensor_files import read_tensors


def test_a_state_on_disk_is_whole_and_has_its_rows(tmp_path, make_trainer):
    root = tmp_path / "root"
    root.mkdir()
    trainer = make_trainer(root, checkpoints=1, log_every=1, save_every_s=0.0)
    with watch(root, tmp_path / "crashes") as disk:
        trainer.train()
    steps = []
    for image in disk.images:
        run = RunDirectory(image)
        for step in run.weight_steps():
            assert read_tensors(run.policy_weights(step))[0]
        if run.last_state.exists():
            _, header = read_tensors(run.last_state)
            step = json.loads(header["details"])["step"]
            rows = [row["step"] for row in read_metrics(run.metrics)]
            assert rows[:step] == [*range(1, step + 1)]
            steps.append(step)
    assert steps == sorted(steps)
    assert steps[-1] == steps[-2] == trainer.step
    assert RunDirectory(disk.images[-2]).weight_steps() == RunDirectory(root).weight_steps()
