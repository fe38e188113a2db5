"""Recordings as a source of episodes, and which source a config opens."""

import numpy as np
import pytest
from mcap.writer import Writer
from synthetic import INSTRUCTION, PARAPHRASES, VIEWS, write_demonstrations, write_episode

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.sources import mcap, opening
from imfvla.sources.mcap import McapSource
from imfvla.tasks.bimanual_robot import bimanual_robot


def test_episodes_are_those_that_were_recorded(synthetic_demonstrations):
    source = McapSource.of(synthetic_demonstrations)
    assert (len(source), source.num_frames(1)) == (3, 12)
    assert source.robot == bimanual_robot(VIEWS, (32, 32))
    episode = source.episode(1, ("top",))
    assert (episode.name, episode.task) == ("episode-00001.mcap", "socket")
    assert episode.instructions == (INSTRUCTION, *PARAPHRASES)
    assert (episode.state.shape, episode.action.shape) == ((24, 16), (24, 16))
    assert {view: pictures.shape for view, pictures in episode.images.items()} == {"top": (12, 32, 32, 3)}
    assert source.episode(1).images == {}
    np.testing.assert_array_equal(episode.image_steps, np.arange(0, 24, 2))


def test_the_digest_changes_with_a_file(synthetic_demonstrations):
    before = McapSource.of(synthetic_demonstrations).digest()
    assert before == McapSource.of(synthetic_demonstrations).digest()
    write_episode(synthetic_demonstrations / "episode-00001.mcap", seed=9)
    assert before != McapSource.of(synthetic_demonstrations).digest()


def test_recordings_of_different_robots_are_not_mixed(synthetic_demonstrations):
    write_episode(synthetic_demonstrations / "episode-00002.mcap", seed=2, image_size=(32, 40))
    source = McapSource.of(synthetic_demonstrations)
    with pytest.raises(
        UserError,
        match=r"episode-00002\.mcap has another robot .*00000\.mcap: .*camera top must be .* 32 x 40 pixels\. Keep",
    ):
        source.episode(2, ("top",))


def test_a_config_opens_what_its_source_says(synthetic_demonstrations):
    config = compose("train", ["task=none", "demos=mcap", f"demos.path={synthetic_demonstrations}"])
    assert isinstance(opening.open_source(config), McapSource)
    assert opening.source_kind(config) == "mcap"
    assert opening.source_kind({"demos": {"episodes": 1}}) == "scripted"  # as configs from before the key


def test_an_unknown_source_or_option_is_named(synthetic_demonstrations):
    config = compose("train", ["demos=mcap", f"demos.path={synthetic_demonstrations}"])
    with pytest.raises(
        UserError, match=r"demos\.source must be one of scripted, mcap, lerobot, .*found 'tape'"
    ):
        opening.open_source(config | {"demos": config["demos"] | {"source": "tape"}})
    with pytest.raises(UserError, match=r"Unknown key demos\.folder"):
        mcap.open_source({"path": "x", "folder": "y"})


def test_a_file_of_another_program_is_not_called_damaged(tmp_path):
    with (tmp_path / "bag.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/joint_states", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(
        UserError, match=r"bag\.mcap is no episode of imfvla: .*imfvla\.episode.*demos=ros2"
    ) as error:
        McapSource.of(tmp_path)
    assert "damaged" not in str(error.value)


def test_a_compression_that_is_not_read_is_not_called_damage(synthetic_demonstrations):
    file = McapSource.of(synthetic_demonstrations).recordings.files[0]
    file.write_bytes(file.read_bytes().replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00snap"))
    with pytest.raises(
        UserError, match=r"has a chunk of compression 'snap', wanted zstd, lz4 or none \(others"
    ):
        McapSource.of(synthetic_demonstrations).episode(0)


def test_a_folder_without_recordings_is_named(tmp_path):
    with pytest.raises(UserError, match=r"No recordings .*nowhere"):
        mcap.open_source({"path": str(tmp_path / "nowhere")})


def test_paraphrases_that_are_no_texts_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("synthetic.PARAPHRASES", {"not": "a list"})
    folder = write_demonstrations(tmp_path / "demos", num_episodes=1)
    with pytest.raises(UserError, match="paraphrases must be a list"):
        McapSource.of(folder)
