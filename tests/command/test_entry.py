import errno
import logging
import os
import signal
import subprocess
import sys

import pytest

from imfvla.command.entry import entry_point, output_directory
from imfvla.errors import UserError
from imfvla.storage.run_log import RunLog


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@entry_point("train")
def command(config):
    if config["seed"] == 1:
        raise UserError("seed 1 is bad.")
    if config["seed"] == 2:
        raise ZeroDivisionError("a mistake of ours")
    if config["seed"] == 3:
        raise KeyboardInterrupt
    if config["seed"] == 7:
        raise OSError(errno.EMFILE, "Too many open files", "data.bin")
    if config["seed"] >= 100:
        os.kill(os.getpid(), config["seed"] - 100)
        signal.pause()
    logging.getLogger("imfvla").info("begun")
    (output_directory() / "done").write_text(type(config["horizon"]).__name__)


def test_hands_plain_config_and_a_deterministic_directory(tmp_path):
    command(["+exp=socket_ph32_exec16"])
    command(["+exp=socket_ph32_exec16"])
    assert (tmp_path / "runs/socket_ph32_exec16/default/done").read_text() == "dict"
    assert len(list(tmp_path.rglob("done"))) == 1
    assert (tmp_path / "runs/socket_ph32_exec16/default/train.log").read_text().count(" INFO begun\n") == 2
    assert not list(tmp_path.rglob(".hydra"))


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["seed=1"], 2, "seed 1 is bad.\n"),
        (["+exp=nope"], 2, None),
        (["seed=3"], 130, "Interrupted.\n"),
        (["seed=102"], 130, "Interrupted.\n"),
        (["seed=115"], 143, "Stopped by SIGTERM; rerun the same command to resume.\n"),
        (["seed=110"], 138, "Stopped by SIGUSR1; rerun the same command to resume.\n"),
        (
            ["seed=7"],
            2,
            "Too many open files at data.bin: no file handle is left; raise the limit with ulimit -n 4096; rerun "
            "the same command.\n",
        ),
    ],
)
def test_mistakes_are_reported_in_one_line(arguments, code, words, capfd):
    with pytest.raises(SystemExit) as exit_:
        command(arguments)
    printed = capfd.readouterr().err
    assert exit_.value.code == code
    assert printed.count("\n") == 1
    assert words in (None, printed)


@pytest.mark.parametrize("mode", [[], ["-m"]])
@pytest.mark.parametrize("in_the_way", ["runs", "runs/x/seed=5/train.log"])
def test_what_hydra_cannot_write_is_reported_in_one_line(tmp_path, capfd, mode, in_the_way):
    (tmp_path / in_the_way).parent.mkdir(parents=True, exist_ok=True)
    if in_the_way == "runs":
        (tmp_path / in_the_way).write_text("no directory")
    else:
        (tmp_path / in_the_way).mkdir()
    with pytest.raises(SystemExit) as exit_:
        command([*mode, "name=x", "seed=5"])
    assert exit_.value.code == 2
    last = capfd.readouterr().err.splitlines()[-1]
    assert f"{in_the_way}: remove what has that name, or choose another directory" in last.replace(
        "/x/seed=5:", ":"
    )


def test_our_own_mistakes_show_a_traceback(capfd):
    with pytest.raises(SystemExit) as exit_:
        command(["seed=2"])
    assert exit_.value.code == 1
    printed = capfd.readouterr().err
    assert "Traceback" in printed
    assert "a mistake of ours" in printed


def test_a_refused_command_leaves_nothing(tmp_path):
    for arguments in (["seed=1"], ["-m", "seed=1,1"]):
        with pytest.raises(SystemExit):
            command(arguments)
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "runs/x").mkdir(parents=True)
    (tmp_path / "runs/x/kept").touch()
    with pytest.raises(SystemExit):
        command(["name=x", "seed=1"])
    assert [path.name for path in tmp_path.rglob("*")] == ["runs", "x", "kept"]


def test_a_message_after_a_refused_job_is_no_error(tmp_path):
    """As Submitit's launcher sends one in the process of the job, whose folder is gone by then."""
    log = RunLog(tmp_path / "gone" / "train.log")
    log.handle(logging.makeLogRecord({"msg": "Job completed"}))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "gone").mkdir()
    log.handle(logging.makeLogRecord({"msg": "kept"}))
    log.close()
    assert (tmp_path / "gone" / "train.log").read_text() == "kept\n"


def test_unknown_override_makes_no_directory(tmp_path):
    with pytest.raises(SystemExit):
        command(["+nope=1"])
    assert list(tmp_path.iterdir()) == []


def test_sweep_runs_all_and_lists_the_failures(tmp_path, capfd):
    with pytest.raises(SystemExit) as exit_:
        command(["-m", "seed=0,1,4", "name=sweep"])
    assert exit_.value.code == 2
    assert sorted(path.parent.name for path in tmp_path.rglob("done")) == ["seed=0", "seed=4"]
    assert "seed 1 is bad." in capfd.readouterr().err


def test_leaves_the_environment_as_it_was():
    before, arguments = dict(os.environ), list(sys.argv)
    command(["seed=5"])
    assert dict(os.environ) == before
    assert sys.argv == arguments


def test_train_command_reports_a_mistake_in_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "imfvla.train", "+exp=nope"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("Unknown exp 'nope': there are ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["../escaped", "/tmp/escaped", "..", "a/b", ".hidden", ""])
def test_a_name_that_is_a_path_is_refused_before_a_directory_is_made(tmp_path, capfd, name):
    with pytest.raises(SystemExit) as exit_:
        command([f"name='{name}'"])
    assert exit_.value.code == 2
    assert "name must consist of letters, digits" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert not (tmp_path.parent / "escaped").exists()
