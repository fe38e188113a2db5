"""A frame store whose bytes changed is refused, and file and block are named; an old one is used with a warning."""

import json
import logging
import os
import shutil

import numpy as np
import pytest

from imfvla.config.horizon import Horizon
from imfvla.data import FrameStore, Loader, ResumableSampler, Windows, checksums
from imfvla.errors import UserError
from imfvla.sources.mcap import McapSource

VIEWS = ("front", "top")


@pytest.fixture
def store(synthetic_demonstrations, tmp_path) -> FrameStore:
    return FrameStore.build(McapSource.of(synthetic_demonstrations), tmp_path / "store", (16, 16), VIEWS)


@pytest.fixture(autouse=True)
def another_process(monkeypatch):
    """A process checks a store once, and all tests share one."""
    monkeypatch.setattr(checksums, "_seen", {})


def forget() -> None:
    checksums._seen.clear()


def loader(store: FrameStore, robot) -> Loader:
    windows = Windows(store, Horizon(obs=1, pred=4, exec=2), robot)
    return Loader(windows, ResumableSampler(len(windows), 4, 0), augment=None)


def change(store: FrameStore, name: str, keep_time: bool = False) -> None:
    """Other contents of the same shape in one of the files."""
    path = store.path / name
    before = path.stat()
    if name == "images.raw":
        path.write_bytes(bytes(before.st_size))
    elif name == "action.npy":
        np.save(path, np.load(path, allow_pickle=False) + np.float32(0.2), allow_pickle=False)
    elif name == "state.npy":
        np.save(path, -np.load(path, allow_pickle=False), allow_pickle=False)
    else:
        meta = json.loads(path.read_text())
        meta["episodes"][0]["instructions"] = ["drop it"]
        path.write_text(json.dumps(meta))
    if keep_time:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("name", ["images.raw", "action.npy", "state.npy", "meta.json"])
def test_a_changed_file_is_named_with_its_block(store, name):
    change(store, name, keep_time=True)
    forget()
    place = "" if name == "meta.json" else r", in block 1 of 1 of 16 MiB"
    with pytest.raises(
        UserError, match=rf"Frame store .*{name} is not as it was written{place}\): delete it"
    ):
        FrameStore.open(store.path)


def test_a_change_is_found_in_the_process_that_has_read_the_store_before(store):
    change(store, "action.npy")
    with pytest.raises(UserError, match=r"action\.npy is not as it was written"):
        FrameStore.open(store.path)


def test_all_that_differs_is_in_one_error(store):
    change(store, "images.raw")
    change(store, "action.npy")
    with pytest.raises(UserError, match=r"images\.raw is not .*; action\.npy is not"):
        FrameStore.open(store.path)


def test_the_blocks_that_differ_are_named(store, tmp_path, monkeypatch):
    monkeypatch.setattr(checksums, "BLOCK_BYTES", 1000)
    monkeypatch.setattr(checksums, "CHUNK_BYTES", 300)
    source = McapSource.of(store.path.parent / "demonstrations")
    small = FrameStore.build(source, tmp_path / "small", (16, 16), VIEWS)
    content = bytearray((small.path / "images.raw").read_bytes())
    assert len(checksums.block_sums(small.path / "images.raw")) == -(-len(content) // 1000)
    for place in (0, 1999, 2000, len(content) - 1):
        content[place] ^= 1
    (small.path / "images.raw").write_bytes(content)
    last = -(-len(content) // 1000)
    with pytest.raises(
        UserError, match=rf"images\.raw is not as it was written, in block 1, 2, 3, {last} of {last}"
    ):
        FrameStore.open(small.path)


@pytest.mark.parametrize("name", ["images.raw", "state.npy", "image_steps.npy"])
def test_a_file_of_terabytes_is_refused_before_it_is_read(store, monkeypatch, name):
    os.truncate(store.path / name, 2**40)
    monkeypatch.setattr(checksums, "block_sums", lambda path: pytest.fail(f"{path} was read"))
    with pytest.raises(UserError, match=rf"{name} has {2**40} bytes, wanted"):
        FrameStore.open(store.path)


def test_a_damaged_store_is_refused_where_it_would_be_used_again(store, synthetic_demonstrations):
    change(store, "images.raw")
    with pytest.raises(UserError, match=r"images\.raw is not as it was written"):
        FrameStore.build(McapSource.of(synthetic_demonstrations), store.path, (16, 16), VIEWS)
    shutil.rmtree(store.path)  # the remedy of the message
    again = FrameStore.build(McapSource.of(synthetic_demonstrations), store.path, (16, 16), VIEWS)
    assert again.content == store.content


def test_a_store_is_read_once_a_process(store, monkeypatch):
    monkeypatch.setattr(checksums, "block_sums", None)
    assert FrameStore.open(store.path).content == store.content


def test_a_store_from_before_checksums_is_used_and_said_once(store, caplog):
    meta = json.loads((store.path / "meta.json").read_text())
    del meta["checksums"]
    (store.path / "meta.json").write_text(json.dumps(meta))
    with caplog.at_level(logging.WARNING):
        found = [FrameStore.open(store.path) for _ in range(2)]
    assert caplog.text.count("before frame stores had checksums") == 1
    assert found[0].content == store.content  # so that a training that resumes notices a change


@pytest.mark.parametrize("name", ["action.npy", "images.raw"])
def test_training_does_not_resume_on_other_arrays(store, synthetic_demonstrations, name):
    """Even where the store has no checksums of its own."""
    robot = McapSource.of(synthetic_demonstrations).robot
    with loader(store, robot) as before:
        state = before.state_dict()
    meta = json.loads((store.path / "meta.json").read_text())
    del meta["checksums"]
    (store.path / "meta.json").write_text(json.dumps(meta))
    change(store, name)
    with (
        loader(FrameStore.open(store.path), robot) as after,
        pytest.raises(
            UserError, match=rf"not those that the saved state was made with: {name} differs; the store"
        ),
    ):
        after.load_state_dict(state)


def test_training_does_not_resume_on_exchanged_demonstrations(store, synthetic_demonstrations, tmp_path):
    """As many steps and frames as before, from other seeds; the store follows the recordings by itself."""
    robot = McapSource.of(synthetic_demonstrations).robot
    with loader(store, robot) as before:
        state = before.state_dict()
    source = McapSource.of(synthetic_demonstrations)
    for file in source.recordings.files[:1]:
        file.write_bytes(source.recordings.files[1].read_bytes())
    exchanged = FrameStore.build(McapSource.of(synthetic_demonstrations), store.path, (16, 16), VIEWS)
    with (
        loader(exchanged, robot) as after,
        pytest.raises(
            UserError, match=r"action\.npy.* differ; the demonstrations were exchanged\. Restore the data"
        ),
    ):
        after.load_state_dict(state)


def test_a_state_from_before_digests_resumes_and_says_so(store, synthetic_demonstrations, caplog):
    with loader(store, McapSource.of(synthetic_demonstrations).robot) as batches:
        state = batches.state_dict()
        del state["data"]
        with caplog.at_level(logging.WARNING):
            batches.load_state_dict(state)
    assert "does not say which data it was made with" in caplog.text
