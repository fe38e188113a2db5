"""The store holds what was recorded, is built once, and is replaced only by a complete one."""

import resource

import numpy as np
import pytest
from synthetic import INSTRUCTION, PARAPHRASES, write_demonstrations, write_episode

from imfvla.data import FrameStore
from imfvla.errors import UserError
from imfvla.recording import read_episode
from imfvla.sources.mcap import McapSource

VIEWS = ("top", "front")


@pytest.fixture
def built(synthetic_demonstrations, tmp_path):
    return FrameStore.build(McapSource.of(synthetic_demonstrations), tmp_path / "store", (32, 32), VIEWS)


def rebuilds(directory, path, size=(32, 32), views=VIEWS) -> int:
    """Number of episodes that a build decodes."""
    told = []
    FrameStore.build(
        McapSource.of(directory), path, size, views, progress=lambda done, total: told.append((done, total))
    )
    assert told == [(done, len(told)) for done in range(1, len(told) + 1)]
    return len(told)


def test_the_store_holds_what_was_recorded(built, synthetic_demonstrations):
    assert built.images.shape == (36, 2, 3, 32, 32)
    assert len(built.episodes) == 3
    for stored in built.episodes:
        episode = read_episode(synthetic_demonstrations / stored.name)
        rows = slice(stored.first_row, stored.first_row + stored.num_steps)
        np.testing.assert_array_equal(built.state[rows], episode.state)
        np.testing.assert_array_equal(built.action[rows], episode.action)
        np.testing.assert_array_equal(stored.image_steps, episode.image_steps)
        assert stored.instructions == (INSTRUCTION, *PARAPHRASES)
        assert stored.task == "socket"
        for number, view in enumerate(VIEWS):
            frames = built.images[stored.first_frame : stored.first_frame + len(stored.image_steps), number]
            np.testing.assert_array_equal(frames.transpose(0, 2, 3, 1), episode.images[view])


def test_the_store_is_mapped_not_read(built):
    assert not built.images.flags.owndata
    assert not built.images.flags.writeable


def test_a_store_is_built_once(synthetic_demonstrations, tmp_path):
    assert rebuilds(synthetic_demonstrations, tmp_path / "store") == 3
    assert rebuilds(synthetic_demonstrations, tmp_path / "store") == 0


def test_a_store_is_rebuilt_when_anything_changed(synthetic_demonstrations, tmp_path):
    path = tmp_path / "store"
    assert rebuilds(synthetic_demonstrations, path) == 3
    assert rebuilds(synthetic_demonstrations, path, views=("front",)) == 3
    assert rebuilds(synthetic_demonstrations, path, views=("front",), size=(16, 16)) == 3
    write_episode(synthetic_demonstrations / "episode-00001.mcap", seed=9)
    assert rebuilds(synthetic_demonstrations, path, views=("front",), size=(16, 16)) == 3
    write_episode(synthetic_demonstrations / "episode-00003.mcap", seed=3)
    assert rebuilds(synthetic_demonstrations, path, views=("front",), size=(16, 16)) == 4
    assert FrameStore.open(path).images.shape == (48, 1, 3, 16, 16)


def test_frames_of_another_size_are_resampled(synthetic_demonstrations, built, tmp_path):
    half = FrameStore.build(McapSource.of(synthetic_demonstrations), tmp_path / "half", (16, 16), VIEWS)
    blocks = built.images.reshape(36, 2, 3, 16, 2, 16, 2).astype(float).mean(axis=(4, 6))
    assert np.abs(half.images - blocks).max() <= 1


def test_no_recordings_are_named(tmp_path):
    with pytest.raises(UserError, match=r"No recordings .*nowhere.*imfvla\.collect"):
        FrameStore.build(McapSource.of(tmp_path / "nowhere"), tmp_path / "store", (32, 32), VIEWS)


def test_a_missing_view_is_named(synthetic_demonstrations, tmp_path):
    with pytest.raises(
        UserError, match=r"no view 'side'.* cameras are front, top, r_wrist.*observation\.views"
    ):
        FrameStore.build(
            McapSource.of(synthetic_demonstrations), tmp_path / "store", (32, 32), ("front", "side")
        )
    assert not (tmp_path / "store").exists()


def test_a_damaged_recording_is_named_and_the_store_stays(synthetic_demonstrations, built, tmp_path):
    images = np.array(built.images)
    victim = synthetic_demonstrations / "episode-00002.mcap"
    whole = victim.read_bytes()
    middle = bytearray(whole)
    middle[len(whole) // 3] ^= 1
    for damage in (whole[:-50], bytes(middle)):
        victim.write_bytes(damage)
        with pytest.raises(UserError, match=r"episode-00002\.mcap is (truncated|damaged)"):
            FrameStore.build(McapSource.of(synthetic_demonstrations), built.path, (32, 32), ("front",))
    np.testing.assert_array_equal(FrameStore.open(built.path).images, images)
    assert not list(tmp_path.glob(".*.part"))


def test_an_action_that_is_not_finite_is_named(tmp_path, monkeypatch):
    actions = np.full((6, 16), np.nan, np.float32)
    monkeypatch.setattr("synthetic.synthetic_actions", lambda seed, num_steps, robot: actions)
    monkeypatch.setattr("synthetic.StillScene.look", lambda self: {"top": np.zeros((32, 32, 3), np.uint8)})
    write_demonstrations(tmp_path / "demonstrations", num_episodes=1, num_steps=6)
    with pytest.raises(
        UserError,
        match=r"Episode episode-00000\.mcap: state of left/joint_1 \[rad\] must be finite, found nan at step 0",
    ):
        FrameStore.build(McapSource.of(tmp_path / "demonstrations"), tmp_path / "store", (32, 32), ("top",))


def test_a_full_disk_is_named_and_the_store_stays(synthetic_demonstrations, built):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
        with pytest.raises(
            UserError, match=r"Cannot write frame store .*store: File too large; .* demos\.frames_directory"
        ):
            FrameStore.build(McapSource.of(synthetic_demonstrations), built.path, (32, 32), ("front",))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert FrameStore.open(built.path).views == VIEWS


def test_too_little_room_is_noticed_before_decoding(synthetic_demonstrations, tmp_path, monkeypatch):
    class Full:
        free = 1000

    monkeypatch.setattr("imfvla.data.store_writing.shutil.disk_usage", lambda path: Full)
    with pytest.raises(UserError, match=r"needs 0\.0 GB, found 0\.0 GB free"):
        FrameStore.build(McapSource.of(synthetic_demonstrations), tmp_path / "store", (32, 32), VIEWS)


@pytest.mark.parametrize("name", ["images.raw", "image_steps.npy", "state.npy", "action.npy", "meta.json"])
def test_a_damaged_store_is_named(built, name):
    file = built.path / name
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(UserError, match=r"Frame store .*store cannot be read .* delete it"):
        FrameStore.open(built.path)
    file.write_bytes(b"")
    with pytest.raises(UserError, match="cannot be read"):
        FrameStore.open(built.path)
    file.unlink()
    with pytest.raises(UserError, match="cannot be read"):
        FrameStore.open(built.path)
