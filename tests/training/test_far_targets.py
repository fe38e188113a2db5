"""What is said of targets that lie far from all others."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import VIEWS, write_demonstrations

from imfvla.config.horizon import Horizon
from imfvla.data import FrameStore, Windows
from imfvla.policy.chunks import ChunkFrame
from imfvla.sources.mcap import McapSource
from imfvla.tasks.bimanual_robot import bimanual_robot
from imfvla.training.far_targets import far_targets

ROBOT = bimanual_robot(VIEWS, (8, 8))
PRED = 4
CHANNEL = 9  # of a joint, so that its targets are displacements


@pytest.fixture
def windows(tmp_path) -> Windows:
    """Two episodes of 12 steps, decided at each of them, whose actions may be written."""
    write_demonstrations(
        tmp_path / "demonstrations", num_episodes=2, num_steps=12, image_size=(8, 8), camera_every=1
    )
    store = FrameStore.build(McapSource.of(tmp_path / "demonstrations"), tmp_path / "store", (8, 8), VIEWS)
    return Windows(replace(store, action=np.array(store.action)), Horizon(1, PRED, PRED), ROBOT)


@pytest.fixture
def chunks(windows) -> ChunkFrame:
    made = ChunkFrame("relative", PRED, ROBOT)
    made.fit(windows.statistics())
    return made


def test_nothing_is_said_of_targets_like_all_others(windows, chunks):
    assert far_targets(windows, chunks) is None


def test_the_farthest_target_is_named_with_its_channel_and_item(windows, chunks):
    deviation = float(chunks.normaliser.scale[0, CHANNEL])
    windows.store.action[12 + 7, CHANNEL] += 300 * deviation  # of the second episode
    found = far_targets(windows, chunks)
    assert found.items == PRED  # all chunks in which this step is
    assert found.deviations == pytest.approx(300, abs=5)
    assert (found.channel, found.item) == (ROBOT.action[CHANNEL], "episode-00001.mcap, step 7")
    assert f"({ROBOT.action[CHANNEL]}, episode-00001.mcap, step 7)" in str(found)


def test_a_step_past_the_end_of_an_episode_is_no_target(windows, chunks):
    """Chunks decided near the end repeat the last action as steps that are not valid."""
    chunks.normaliser.scale[1:] = 1e-9  # later steps of a chunk would be far away, were they valid
    windows._frame = windows._frame[[11]]  # the last decision of the first episode
    assert far_targets(windows, chunks) is None
