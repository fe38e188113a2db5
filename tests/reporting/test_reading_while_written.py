"""A report reads run directories into which other commands write."""

import os

import pytest
from synthetic_runs import make_run, write_evaluation

from imfvla.errors import UserError
from imfvla.reporting import runs
from imfvla.reporting.runs import evaluations, find_runs
from imfvla.storage.run_directory import RunDirectory


def test_a_folder_that_a_training_deletes_meanwhile_is_no_error(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    (run / "checkpoints" / "state.tmp.part").mkdir(parents=True)
    scandir = os.scandir

    def deleted(path="."):
        if os.fspath(path).endswith(".part"):
            raise FileNotFoundError(path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", deleted)
    assert [found.path for found in find_runs([tmp_path])] == [run]


def test_an_evaluation_that_is_replaced_meanwhile_is_read_again(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    folder = write_evaluation(run, 1, number=3)
    read, calls = runs.recomputed, []

    def replaced(*arguments, **options):
        """Another command has written its rows when these are read, and its summary afterwards."""
        calls.append(arguments)
        if len(calls) == 1:
            text = (folder / "summary.json").read_bytes()
            (folder / "summary.json").unlink()
            (folder / "new").write_bytes(text)
            (folder / "new").rename(folder / "summary.json")
            raise UserError("other rows")
        return read(*arguments, **options)

    monkeypatch.setattr(runs, "recomputed", replaced)
    assert len(evaluations(RunDirectory(run))) == 1
    assert len(calls) == 2


def test_an_evaluation_whose_summary_vanishes_meanwhile_is_not_finished(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    folder = write_evaluation(run, 1, number=3)

    def removed(*_, **__):
        (folder / "summary.json").unlink()
        raise UserError("no rows")

    monkeypatch.setattr(runs, "recomputed", removed)
    assert evaluations(RunDirectory(run)) == []


def test_an_evaluation_that_stays_wrong_is_an_error(tmp_path):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    (write_evaluation(run, 1, number=3) / "episodes.jsonl").write_text("")
    with pytest.raises(UserError, match=r"episodes\.jsonl"):
        evaluations(RunDirectory(run))
