import json

import pytest

from imfvla.errors import UserError
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import MetricsLogger, read_metrics


def test_rows_are_means_since_the_last_row(tmp_path):
    run = RunDirectory(tmp_path)
    logger = MetricsLogger(run, 0)
    for loss in (1.0, 3.0):
        logger.add({"loss": loss})
    logger.write(2, steps_per_s=5.0)
    logger.add({"loss": 7.0})
    logger.write(3)
    logger.close()
    assert read_metrics(run.metrics) == [
        {"step": 2, "loss": 2.0, "steps_per_s": 5.0},
        {"step": 3, "loss": 7.0},
    ]


def test_interval_resumes_from_its_state(tmp_path):
    logger = MetricsLogger(RunDirectory(tmp_path / "a"), 0)
    logger.add({"loss": 0.1})
    state = json.loads(json.dumps(logger.state()))
    resumed = MetricsLogger(RunDirectory(tmp_path / "b"), 1, state)
    for one in (logger, resumed):
        one.add({"loss": 0.7})
        one.write(2)
        one.close()
    assert (tmp_path / "a" / "metrics.jsonl").read_text() == (tmp_path / "b" / "metrics.jsonl").read_text()


def test_cuts_off_later_rows_and_half_lines(tmp_path):
    run = RunDirectory(tmp_path)
    run.metrics.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"st')
    MetricsLogger(run, 2).close()
    assert run.metrics.read_text() == '{"step": 1}\n{"step": 2}\n'


def test_damaged_row_is_reported(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\noops\n{"step": 3}\n')
    with pytest.raises(UserError, match=r"metrics\.jsonl, line 2 is not JSON"):
        read_metrics(tmp_path / "metrics.jsonl")
