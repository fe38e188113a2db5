"""Episodes of any source become recordings of this project."""

from dataclasses import replace

import numpy as np
import pytest
from outside import ROBOT, episode

from imfvla.errors import UserError
from imfvla.recording import Recordings, read_episode, read_index
from imfvla.sources.mcap_writer import McapWriter


def test_recordings_keep_everything_that_an_episode_has(tmp_path):
    made = replace(
        episode(1, 9, every=2), instructions=("put it there", "place it"), imitate=np.arange(9) > 3
    )
    with McapWriter(tmp_path / "new", ROBOT) as writer:
        writer.add(episode(0, 4))
        writer.add(made)
    files = Recordings.of(tmp_path / "new").files
    assert [file.name for file in files] == ["episode-000000.mcap", "episode-000001.mcap"]
    read = read_episode(files[1])
    assert read.info.robot == ROBOT
    assert (read.info.task, read.info.instruction) == (made.task, "put it there")
    assert read.info.metadata == {"converted_from": "made_1", "paraphrases": ["place it"]}
    assert np.array_equal(read.state, made.state)
    assert np.array_equal(read.action, made.action)
    assert np.array_equal(read.executed, made.action)
    assert np.array_equal(read.imitate, made.imitate)
    assert read_episode(files[0]).imitate is None
    assert np.allclose(read.time_s, np.arange(9) / ROBOT.control_hz)
    assert np.array_equal(read.image_steps, made.image_steps)
    for view, frames in made.images.items():
        assert np.array_equal(read.images[view], frames)
    assert read_index(files[0]).num_frames == {"front": 4, "wrist": 4}
    assert not read.result.success


def test_robots_without_cameras_are_written_too(tmp_path):
    robot = replace(ROBOT, cameras=())
    with McapWriter(tmp_path / "new", robot) as writer:
        writer.add(replace(episode(0, robot=robot), image_steps=np.zeros(0, np.int64)))
    assert read_episode(tmp_path / "new" / "episode-000000.mcap").info.robot == robot


def write_all(path, *episodes):
    with McapWriter(path, ROBOT) as writer:
        for made in episodes:
            writer.add(made)


def test_an_error_leaves_nothing_and_nothing_is_overwritten(tmp_path):
    bad = episode(1)
    bad = replace(bad, images=bad.images | {"front": bad.images["wrist"]})
    with pytest.raises(UserError, match=r"front.*64 x 96.*64 x 64"):
        write_all(tmp_path / "new", episode(0), bad)
    with pytest.raises(UserError, match="at least one episode"):
        write_all(tmp_path / "new")
    assert not list(tmp_path.iterdir())
    write_all(tmp_path / "new", episode(0))
    with pytest.raises(UserError, match="exists already"):
        write_all(tmp_path / "new", episode(0))
