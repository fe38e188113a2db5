import json
from pathlib import Path

import numpy as np
import pytest

from imfvla import collection
from imfvla.collection import collect
from imfvla.composition import compose
from imfvla.errors import UserError
from imfvla.recording import episode_is_complete, read_episode

TASK = {"name": "transfer", "variant": "easy", "expert": {"modes": 2, "noise": 0.002, "hold": 18}}
OBSERVATION = {"views": ["front", "r_wrist"], "image_size": [24, 32]}


def demos(directory: Path, **changes) -> dict:
    return {
        "episodes": 2, "first_seed": 0, "directory": str(directory), "frames_directory": None,
        "camera_every": 8, "workers": 0, **changes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return collect(TASK, OBSERVATION, demos(tmp_path_factory.mktemp("demos")))


@pytest.fixture
def played(monkeypatch):
    """Instead of playing: seeds 1 and 4 fail, others leave an empty file. Lists the seeds that were played."""
    seeds = []

    def record(settings, directory, seed):
        seeds.append(seed)
        if seed in (1, 4):
            return seed, False
        collection._path(directory, seed).write_bytes(b"episode")
        return seed, True

    monkeypatch.setattr(collection, "record_demonstration", record)
    monkeypatch.setattr(collection, "episode_is_complete", lambda path: path.read_bytes() == b"episode")
    return seeds


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.glob("*.mcap"))


def test_demonstrations_are_complete_recordings_of_successes(recorded):
    assert (recorded.num_episodes, recorded.num_new, recorded.num_failed) == (2, 2, 0)
    assert recorded.directory.name == "transfer-easy-modes2-24x32"
    assert files(recorded.directory) == ["episode-000000.mcap", "episode-000001.mcap"]
    for seed, path in enumerate(sorted(recorded.directory.glob("*.mcap"))):
        assert episode_is_complete(path)
        episode = read_episode(path)
        assert (episode.info.kind, episode.info.task, episode.info.seed) == (
            "demonstration",
            "transfer",
            seed,
        )
        assert episode.info.metadata["style"]["turn_right"] in (-1, 1)
        assert episode.result.success
        assert episode.stage[-1] == 4
        assert set(episode.images) == {"front", "r_wrist"}
        assert episode.images["front"].shape == (len(episode.image_steps), 24, 32, 3)
        np.testing.assert_array_equal(episode.image_steps, np.arange(0, len(episode.state), 8))
        assert np.abs(episode.action - episode.executed).max() > 0


def test_what_is_there_is_kept(recorded):
    before = {path: path.stat().st_mtime_ns for path in recorded.directory.glob("*.mcap")}
    again = collect(TASK, OBSERVATION, demos(recorded.directory.parent))
    assert (again.directory, again.num_new) == (recorded.directory, 0)
    assert {path: path.stat().st_mtime_ns for path in recorded.directory.glob("*.mcap")} == before


def test_a_truncated_recording_is_made_again(recorded):
    path = recorded.directory / "episode-000001.mcap"
    whole = path.read_bytes()
    actions = read_episode(path, images=False).action
    path.write_bytes(whole[: len(whole) // 2])
    again = collect(TASK, OBSERVATION, demos(recorded.directory.parent))
    assert again.num_new == 1
    np.testing.assert_array_equal(read_episode(path, images=False).action, actions)


def test_fewer_than_there_are_come_as_links(recorded):
    fewer = collect(TASK, OBSERVATION, demos(recorded.directory.parent, episodes=1))
    assert fewer.directory != recorded.directory
    assert files(fewer.directory) == ["episode-000000.mcap"]
    assert episode_is_complete(fewer.directory / "episode-000000.mcap")


def test_a_folder_of_other_settings_is_refused_and_kept(recorded):
    before = files(recorded.directory)
    for task, observation in (
        ({**TASK, "expert": {"modes": 2, "noise": 0.01, "hold": 18}}, OBSERVATION),
        (TASK, {**OBSERVATION, "views": ["front"]}),
    ):
        with pytest.raises(UserError, match=r"was recorded with (noise|views)=.* is wanted; choose another"):
            collect(task, observation, demos(recorded.directory.parent))
    assert files(recorded.directory) == before


def test_failures_are_counted_left_out_and_not_tried_again(played, tmp_path):
    report = collect(TASK, OBSERVATION, demos(tmp_path, episodes=5))
    assert played == [0, 1, 2, 3, 4, 5, 6]
    assert (report.num_episodes, report.num_new, report.num_failed) == (5, 5, 2)
    assert files(report.directory) == [f"episode-{seed:06d}.mcap" for seed in (0, 2, 3, 5, 6)]
    assert json.loads((report.directory / "collection.json").read_text())["failed_seeds"] == [1, 4]
    played.clear()
    report = collect(TASK, OBSERVATION, demos(tmp_path, episodes=6))
    assert played == [7]
    assert (report.num_new, report.num_failed) == (1, 2)


def test_the_seeds_used_do_not_depend_on_interruptions(played, tmp_path):
    for episodes in (1, 3):
        collect(TASK, OBSERVATION, demos(tmp_path, episodes=episodes))
    whole = collect(TASK, OBSERVATION, demos(tmp_path, episodes=5)).directory
    assert files(whole) == [f"episode-{seed:06d}.mcap" for seed in (0, 2, 3, 5, 6)]


def test_the_seeds_of_the_band_can_run_out(played, tmp_path):
    with pytest.raises(UserError, match=r"demos.episodes=3 cannot be had: .* end at 9999"):
        collect(TASK, OBSERVATION, demos(tmp_path, episodes=3, first_seed=9998))


@pytest.mark.parametrize(
    ("key", "value"), [("episodes", 0), ("first_seed", 10_000), ("camera_every", 0), ("workers", -1)]
)
def test_mistakes_are_named(key, value, tmp_path):
    with pytest.raises(UserError, match=f"demos.{key}"):
        collect(TASK, OBSERVATION, demos(tmp_path, **{key: value}))


def test_a_damaged_log_is_named(played, tmp_path):
    directory = collect(TASK, OBSERVATION, demos(tmp_path)).directory
    (directory / "collection.json").write_text("{")
    with pytest.raises(UserError, match=r"collection.json is damaged .* remove .* to record it anew"):
        collect(TASK, OBSERVATION, demos(tmp_path))


def test_training_and_collecting_agree_on_what_is_wanted():
    train, alone = compose("train", ["task=socket"]), compose("collect", ["task=socket"])
    assert train["task"] == alone["task"]
    assert train["demos"] == {key: alone[key] for key in train["demos"]}
    for key in ("views", "image_size"):
        assert train["observation"][key] == alone["observation"][key]
