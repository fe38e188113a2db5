"""What does not fit its source's robot is named once: episode, key, wanted, found, remedy."""

from dataclasses import replace

import numpy as np
import pytest
from any_robot import MemorySource, names_of, robot_of_size

from imfvla.data import FrameStore
from imfvla.errors import UserError
from imfvla.sources.validation import check_episode

ROBOT = robot_of_size(8, 9, num_cameras=2)
EPISODE = MemorySource(ROBOT, num_episodes=1).episodes[0]
VIEWS = names_of(ROBOT.cameras)


def holed(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[3, 2] = np.nan
    return values


def test_what_fits_passes():
    check_episode(EPISODE, ROBOT, VIEWS)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (
            {"state": EPISODE.state[:, :8]},
            r"state must be .*\(20, 9\), 20 steps of 9 channels, found .*\(20, 8\)",
        ),
        ({"state": EPISODE.state.astype(float)}, "state must be float32 of .*found float64"),
        ({"state": EPISODE.state[:0]}, "state must be at least one control step"),
        ({"action": EPISODE.action[:-1]}, r"action must be .*\(20, 8\).*found .*\(19, 8\)"),
        (
            {"action": holed(EPISODE.action)},
            r"action of part_2/target \[rad\] must be finite, found nan at step 3",
        ),
        ({"instructions": ()}, "instructions must be at least one sentence"),
        (
            {"image_steps": np.array([0, 2, 2])},
            r"image_steps must be ascending steps below 20, found \[0, 2, 2\]",
        ),
        ({"image_steps": np.array([0, 99])}, "image_steps must be ascending steps below 20"),
        ({"imitate": np.ones(20, int)}, r"imitate must be bool of shape \(20,\).*found int64"),
        (
            {"imitate": np.ones(19, bool)},
            r"imitate must be bool of shape \(20,\).*found bool of shape \(19,\)",
        ),
        ({"imitate": np.zeros(20, bool)}, "imitate must be bool .*true at one step at least"),
        ({"images": {"camera_0": EPISODE.images["camera_0"]}}, "camera_1 must be recorded, found camera_0"),
        (
            {"images": EPISODE.images | {"camera_1": EPISODE.images["camera_0"]}},
            r"camera_1 must be uint8 of shape \(10, 16, 16, 3\).*found uint8 of shape \(10, 24, 32, 3\)",
        ),
    ],
)
def test_what_does_not_fit_is_named(changes, named):
    with pytest.raises(
        UserError, match=f"^Episode episode 0: .*{named}.*Correct the episode, or leave it out"
    ):
        check_episode(replace(EPISODE, **changes), ROBOT, VIEWS)


def test_a_store_is_not_built_from_what_does_not_fit(tmp_path):
    source = MemorySource(ROBOT)
    source.episodes[2] = replace(source.episodes[2], action=holed(source.episodes[2].action))
    with pytest.raises(UserError, match="Episode episode 2: action of part_2"):
        FrameStore.build(source, tmp_path / "store", (16, 16), VIEWS)
    assert not list(tmp_path.glob("store*"))


def test_cameras_of_different_sizes_are_seen_at_one(tmp_path):
    store = FrameStore.build(MemorySource(ROBOT), tmp_path / "store", (16, 16), VIEWS)
    assert store.images.shape == (40, 2, 3, 16, 16)
    same_size = EPISODE.images["camera_1"].transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(store.images[:10, 1], same_size)  # not resampled
