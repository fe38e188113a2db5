import numpy as np
import pytest
from any_robot import MemorySource, names_of, robot_of_size

from imfvla.config.horizon import Horizon
from imfvla.data import FrameStore, Windows
from imfvla.data.held_out import held_out
from imfvla.errors import UserError
from imfvla.training.data import held_out_windows

NONE = {"name": "none", "paraphrases": False}


@pytest.mark.parametrize(
    ("wanted", "expected"), [(0.1, (5,)), (2, (2, 7)), (0.25, (2, 7)), (9, (0, 1, 2, 3, 5, 6, 7, 8, 9))]
)
def test_episodes_are_kept_evenly(wanted, expected):
    kept = held_out(NONE | {"held_out": wanted}, 10)
    assert len(kept) == len(expected)
    if wanted != 9:
        assert kept == expected


def test_a_task_with_an_environment_keeps_none():
    assert held_out({"name": "socket"}, 10) == ()


@pytest.mark.parametrize("wanted", [10, 11, 0.01, 0.99])
def test_nothing_left_to_train_or_to_judge_on_is_refused(wanted):
    with pytest.raises(UserError, match=r"task\.held_out must leave .* 10 episodes .* found"):
        held_out(NONE | {"held_out": wanted}, 10)


@pytest.mark.parametrize("wanted", [0, -1, "many", True])
def test_what_is_no_number_is_refused(wanted):
    with pytest.raises(UserError, match=r"task\.held_out must be"):
        held_out(NONE | {"held_out": wanted}, 10)


def test_statistics_and_windows_see_only_their_episodes(tmp_path):
    robot = robot_of_size(7, 7)
    source = MemorySource(robot)
    store = FrameStore.build(source, tmp_path / "store", (8, 8), names_of(robot.cameras))
    windows = Windows(store, Horizon(1, 4, 2), robot, episodes=(0, 3))
    other = held_out_windows(windows)
    assert set(windows.decisions(np.arange(len(windows)))[0]) == {0, 3}
    assert set(other.decisions(np.arange(len(other)))[0]) == {1, 2}
    state = np.concatenate([source.episodes[number].state for number in (0, 3)])
    np.testing.assert_array_equal(windows.statistics().state_max, state.max(axis=0))
    kept, actions, valid = other.decided(np.array([0]))
    np.testing.assert_array_equal(kept[0], source.episodes[1].state[0])
    np.testing.assert_array_equal(actions[0], source.episodes[1].action[:4])
    assert valid.all()
