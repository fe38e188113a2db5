"""Attacks on a directory that somebody else made: links out of it, what blocks, what has no end."""

import logging
import os
import socket
from pathlib import Path

import pytest
from safetensors.torch import save_file
from synthetic import write_demonstrations, write_episode
from synthetic_runs import make_run, write_evaluation
from torch import nn

from imfvla.data import FrameStore
from imfvla.errors import UserError
from imfvla.nn.pretrained import read_weights
from imfvla.recording import Recordings, read_episode, read_index
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.media import Media
from imfvla.reporting.runs import evaluations
from imfvla.reporting.shipping import ship
from imfvla.rollouts.rollout_log import PARTIAL, RolloutLog
from imfvla.sources.mcap import McapSource
from imfvla.storage.documents import read_json, read_lines, read_yaml
from imfvla.storage.files import copy_file, locked
from imfvla.storage.opening import (
    JSON,
    OF_SUFFIX,
    YAML,
    checked,
    kind_of,
    open_to_append,
    open_to_read,
    refuse_strangers,
)
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.run_log import RunLog
from imfvla.training.checkpoint import load_weights
from imfvla.training.logger import MetricsLogger, read_metrics
from imfvla.training.tensor_files import read_tensors

READERS = {
    "status.json": lambda path: RunDirectory(path.parent).status(),
    "config.yaml": lambda path: RunDirectory(path.parent).config(),
    "other.json": lambda path: read_json(path, "restore it"),
    "tables.yaml": read_yaml,
    "rows.jsonl": lambda path: read_lines(path, "restore it"),
    "metrics.jsonl": read_metrics,
    "curve/metrics.jsonl": lambda path: learning_curve(path.parent),
    "episode.mcap": read_episode,
    "index.mcap": read_index,
    "policy.safetensors": lambda path: load_weights(nn.Linear(3, 2), path),
    "any.safetensors": read_tensors,
    "store/meta.json": lambda path: FrameStore.open(path.parent),
    f"rollouts/{PARTIAL}": lambda path: RolloutLog(path.parent, {}).__enter__().begin(),
    "video.mp4": lambda path: copy_file(path, path.parent / "copy" / path.name),
    "train.log": lambda path: RunLog(path),
    ".lock": lambda path: RunDirectory(path.parent).lock().__enter__(),
}


def link(path: Path) -> None:
    secret = path.parents[2] / "secret"
    secret.write_text("{}\n")
    path.symlink_to(secret)


def listen(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        here = os.getcwd()
        os.chdir(path.parent)  # the name of a socket may have 100 letters
        try:
            server.bind(path.name)
        finally:
            os.chdir(here)


STRANGERS = {
    "a named pipe": os.mkfifo,
    "a socket": listen,
    "a directory": Path.mkdir,
    "links out of": link,
    "a device": lambda path: os.mknod(path, 0o20666, os.makedev(1, 5)),  # zeros without end
}


@pytest.mark.parametrize("stranger", STRANGERS)
@pytest.mark.parametrize("name", READERS)
def test_no_reader_follows_or_waits(tmp_path, name, stranger):
    path = tmp_path / "outer" / "given" / name
    path.parent.mkdir(parents=True)
    try:
        STRANGERS[stranger](path)
    except PermissionError:
        pytest.skip("only root may make a device")
    with pytest.raises(UserError, match=stranger):
        READERS[name](path)
    assert not (tmp_path / "outer" / "given" / "copy" / path.name).exists()


def test_a_link_that_stays_inside_and_one_of_the_directory_itself_are_followed(tmp_path):
    (tmp_path / "real" / "b").mkdir(parents=True)
    (tmp_path / "real" / "b" / "x.json").write_text("1")
    (tmp_path / "real" / "a.json").symlink_to("b/x.json")
    (tmp_path / "given").symlink_to("real")
    assert read_json(tmp_path / "given" / "a.json", "") == 1
    assert read_json(tmp_path / "given" / "a.json", "", home=tmp_path / "given") == 1
    refuse_strangers(tmp_path / "given")


def test_a_link_of_a_directory_leads_no_file_out(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x.json").write_text("1")
    (home / "inner").symlink_to(tmp_path / "other")
    with pytest.raises(UserError, match="links out of"):
        read_json(home / "inner" / "x.json", "", home=home)


def test_a_loop_of_links_ends(tmp_path):
    (tmp_path / "a.json").symlink_to("b.json")
    (tmp_path / "b.json").symlink_to("a.json")
    with pytest.raises(UserError):
        read_json(tmp_path / "a.json", "remove it")


@pytest.mark.parametrize("suffix", sorted(OF_SUFFIX))
def test_what_is_too_large_is_refused_before_it_is_read(tmp_path, suffix):
    path, kind = tmp_path / f"a{suffix}", kind_of(Path(f"a{suffix}"))
    with open(path, "wb") as stream:
        stream.truncate(int(kind.most))
    checked(path, kind)
    with open(path, "wb") as stream:
        stream.truncate(int(kind.most) + 1)
    with pytest.raises(UserError, match=rf"bytes, wanted at most {kind.most} of a {kind.name}"):
        open_to_read(path, kind)
    with pytest.raises(UserError, match="wanted at most"):
        copy_file(path, tmp_path / "copy" / path.name)
    path.unlink()


def test_weights_may_have_what_the_policy_needs_and_no_more(tmp_path):
    path = tmp_path / "policy.safetensors"
    save_file(nn.Linear(3, 2).state_dict(), path)
    load_weights(nn.Linear(3, 2), path)
    with open(path, "wb") as stream:
        stream.truncate(8 * 10**9)  # of zeros, which take no space
    with pytest.raises(UserError, match="8000000000 bytes, wanted at most"):
        load_weights(nn.Linear(3, 2), path)


def test_weights_to_begin_with_may_be_a_link_of_the_user_but_no_pipe(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    save_file(nn.Linear(3, 2).state_dict(), tmp_path / "elsewhere" / "x.safetensors")
    (tmp_path / "a.safetensors").symlink_to(tmp_path / "elsewhere" / "x.safetensors")
    assert read_weights(tmp_path / "a.safetensors", "encoder.pretrained")
    os.mkfifo(tmp_path / "b.safetensors")
    with pytest.raises(UserError, match=r"encoder\.pretrained: .*a named pipe"):
        read_weights(tmp_path / "b.safetensors", "encoder.pretrained")


@pytest.mark.parametrize("name", ["train.log", "made_by.json", "rollouts/default-nfe1/z.mcap"])
def test_a_published_page_copies_nothing_from_outside(tmp_path, name):
    run = tmp_path / "run"
    (run / name).parent.mkdir(parents=True)
    (tmp_path / "secret").write_text("of the user")
    (run / name).symlink_to(tmp_path / "secret")
    media = Media(tmp_path / "page", is_copied=True)
    with pytest.raises(UserError, match=f"links out of {run}"):
        media.link(run / name, run)
    with pytest.raises(UserError, match=f"links out of {run}"):
        copy_file(run / name, tmp_path / "page" / Path(name).name, home=run)
    assert not (tmp_path / "page").exists()


def test_an_evaluation_that_is_a_link_to_another_place_is_not_reported(tmp_path):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    other = make_run(tmp_path / "other", "socket_ph32_exec16")
    folder = write_evaluation(other, 1, number=3)
    (run / "rollouts").mkdir(exist_ok=True)
    (run / "rollouts" / folder.name).symlink_to(folder)
    with pytest.raises(UserError, match=f"links out of {run}"):
        evaluations(RunDirectory(run))


def test_nothing_from_outside_is_shipped(tmp_path):
    run = make_run(tmp_path / "run", "socket_ph32_exec16")
    write_evaluation(run, 1, number=3)
    (tmp_path / "secret").write_text('{"state": "done"}')
    (run / "status.json").unlink(missing_ok=True)
    (run / "status.json").symlink_to(tmp_path / "secret")
    with pytest.raises(UserError, match="links out of"):
        ship(RunDirectory(run), tmp_path / "shipped")
    assert not (tmp_path / "shipped").exists()


@pytest.mark.parametrize("name", ["train.log", "metrics.jsonl", ".lock"])
def test_writers_append_to_nothing_outside(tmp_path, name):
    run = RunDirectory(tmp_path / "run")
    run.path.mkdir()
    (run.path / name).symlink_to(tmp_path / "made")
    writers = {
        "train.log": lambda: RunLog(run.path / name),
        "metrics.jsonl": lambda: MetricsLogger(run, 0),
        ".lock": lambda: run.lock().__enter__(),
    }
    with pytest.raises(UserError, match="links out of"):
        writers[name]()
    assert not (tmp_path / "made").exists()


def test_a_partial_recording_that_is_a_link_is_replaced(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("of the user")
    (tmp_path / ".a.mcap.part").symlink_to(precious)
    write_episode(tmp_path / "a.mcap", 0, num_steps=3, views=("front",), image_size=(16, 16))
    assert precious.read_text() == "of the user"
    assert read_episode(tmp_path / "a.mcap")


def test_a_lock_that_is_a_link_out_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / ".store.lock").symlink_to(tmp_path / "made")
    with pytest.raises(UserError, match="links out of"), locked(tmp_path / "folder" / "store"):
        pass
    assert not (tmp_path / "made").exists()


def test_a_recording_that_is_a_link_out_of_its_folder_is_no_data(tmp_path):
    write_demonstrations(tmp_path / "real", num_episodes=1, num_steps=3)
    (file,) = (tmp_path / "real").glob("*.mcap")
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / file.name).symlink_to(file)
    with pytest.raises(UserError, match="links out of"):
        McapSource(Recordings.of(tmp_path / "given"))


def test_a_log_is_appended_to(tmp_path):
    handler = RunLog(tmp_path / "train.log")
    handler.emit(logging.LogRecord("a", logging.INFO, "", 0, "one", None, None))
    handler.close()
    with open_to_append(tmp_path / "train.log") as stream:
        stream.write("two\n")
    assert (tmp_path / "train.log").read_text() == "one\ntwo\n"


def test_kinds_are_told_by_the_end_of_a_name():
    assert kind_of(Path("a.json")) is JSON
    assert kind_of(Path("a.yaml")) is YAML
    with pytest.raises(UserError, match=r"x\.pem must end in one of"):
        kind_of(Path("x.pem"))


def test_folders_nested_too_deeply_are_an_error(tmp_path, monkeypatch):
    def too_deep(_):
        yield str(tmp_path), [], []
        raise RecursionError

    monkeypatch.setattr(os, "walk", too_deep)  # as up to Python 3.11 beyond some 500 levels
    with pytest.raises(UserError, match="nested hundreds of levels deep"):
        refuse_strangers(tmp_path)
