"""Where the frame store of a training lies, and what it is made of."""

import shutil

import pytest

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.recording import Recordings
from imfvla.sources.mcap import McapSource
from imfvla.training.data import prepare_windows

OVERRIDES = ("observation.image_size=[32,32]",)


def windows(source: McapSource, *overrides: str):
    return prepare_windows(compose("train", [*OVERRIDES, *overrides]), source)


def test_the_store_lies_beside_the_demonstrations_or_where_the_key_says(synthetic_demonstrations, tmp_path):
    source = McapSource.of(synthetic_demonstrations)
    beside = windows(source)
    assert beside.store.path == synthetic_demonstrations.with_name("demonstrations_frames_32x32")
    shutil.rmtree(beside.store.path)
    elsewhere = windows(source, f"demos.frames_directory={tmp_path}/fast/disk")
    assert elsewhere.store.path == tmp_path / "fast" / "disk" / "demonstrations_frames_32x32"
    assert not beside.store.path.exists()


def test_only_what_is_named_is_trained_on(synthetic_demonstrations):
    all_of_them = McapSource.of(synthetic_demonstrations)
    names = [path.name for path in all_of_them.recordings.files[:2]]
    two = windows(McapSource(Recordings.named(synthetic_demonstrations, names, "two")))
    assert [episode.name for episode in two.store.episodes] == names
    assert 3 * len(two) == 2 * len(windows(all_of_them))


def test_a_place_that_takes_no_store_is_named_with_the_key(synthetic_demonstrations, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"frame store .*; choose .*demos\.frames_directory"):
        windows(McapSource.of(synthetic_demonstrations), f"demos.frames_directory={tmp_path}/file/frames")


def test_what_is_no_frame_store_is_not_replaced(synthetic_demonstrations, tmp_path):
    mine = tmp_path / "frames" / "demonstrations_frames_32x32" / "thesis.tex"
    mine.parent.mkdir(parents=True)
    mine.write_text("results")
    with pytest.raises(UserError, match="is not a frame store: move it away"):
        windows(McapSource.of(synthetic_demonstrations), f"demos.frames_directory={tmp_path}/frames")
    assert mine.read_text() == "results"
