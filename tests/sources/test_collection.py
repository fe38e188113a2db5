import json
from pathlib import Path

import numpy as np
import pytest

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.recording import read_episode
from imfvla.sources import collection
from imfvla.sources.collection import collect, recorded_seeds

TASK = {"name": "transfer", "variant": "easy", "expert": {"modes": 2, "noise": 0.002, "hold": 18, "dwell": 0}}
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
    """Instead of playing: seeds 1, 4 and 1000001 fail, others leave an empty file. Lists the seeds that were played."""
    seeds = []

    def record(settings, directory, seed):
        seeds.append(seed)
        if seed in (1, 4, 1_000_001):
            return seed, False
        collection.recording_path(directory, seed).write_bytes(b"episode")
        return seed, True

    monkeypatch.setattr(collection, "record_demonstration", record)
    monkeypatch.setattr(collection, "_is_recorded", lambda directory, seed, settings: True)
    return seeds


def folder(report: collection.Report) -> Path:
    return report.recordings.directory


def contents(report: collection.Report) -> dict[Path, int]:
    """The recordings and when they were written."""
    return {path: path.stat().st_mtime_ns for path in folder(report).glob("*.mcap")}


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.glob("*.mcap"))


def test_demonstrations_are_complete_recordings_of_successes(recorded):
    assert (recorded.num_new, recorded.num_failed) == (2, 0)
    assert recorded.recordings.name == folder(recorded).name == "transfer-easy-modes2-24x32"
    assert files(folder(recorded)) == ["episode-000000.mcap", "episode-000001.mcap"]
    assert recorded.recordings.files == tuple(sorted(folder(recorded).glob("*.mcap")))
    for seed, path in enumerate(recorded.recordings.files):
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
    before = contents(recorded)
    again = collect(TASK, OBSERVATION, demos(folder(recorded).parent))
    assert (again.recordings, again.num_new) == (recorded.recordings, 0)
    assert contents(recorded) == before


def test_a_truncated_recording_is_made_again(recorded):
    path = recorded.recordings.files[1]
    whole = path.read_bytes()
    actions = read_episode(path, images=False).action
    path.write_bytes(whole[: len(whole) // 2])
    again = collect(TASK, OBSERVATION, demos(folder(recorded).parent))
    assert again.num_new == 1
    np.testing.assert_array_equal(read_episode(path, images=False).action, actions)


def test_a_file_that_may_be_whole_is_not_recorded_over(recorded):
    path = recorded.recordings.files[1]
    whole = path.read_bytes()
    for strange in (path.with_name("episode-000000.mcap").read_bytes(), b"PK\3\4" + whole):
        path.write_bytes(strange)
        with pytest.raises(UserError, match=r"episode-000001\.mcap .*move it away"):
            collect(TASK, OBSERVATION, demos(folder(recorded).parent))
        assert path.read_bytes() == strange
    path.write_bytes(whole)


def test_fewer_than_there_are_are_chosen_without_writing_anything(recorded):
    before = contents(recorded)
    fewer = collect(TASK, OBSERVATION, demos(folder(recorded).parent, episodes=1)).recordings
    assert fewer.files == recorded.recordings.files[:1]
    assert fewer.name != recorded.recordings.name
    assert contents(recorded) == before
    assert [path.name for path in folder(recorded).parent.iterdir() if path.is_dir()] == [
        folder(recorded).name
    ]


def test_files_beside_the_demonstrations_are_named_and_not_used(recorded, caplog):
    first = recorded.recordings.files[0]
    strays = [first.with_name(name) for name in ("episode-000000 (1).mcap", "episode-3.mcap", "mine.mcap")]
    for stray in strays:
        stray.write_bytes(first.read_bytes())
    again = collect(TASK, OBSERVATION, demos(folder(recorded).parent))
    assert (again.recordings, again.num_new) == (recorded.recordings, 0)
    for stray in strays:
        assert repr(stray.name) in caplog.text
        assert stray.exists()
        stray.unlink()


def test_a_folder_of_other_settings_is_refused_and_kept(recorded):
    before = files(folder(recorded))
    for task, observation in (
        ({**TASK, "expert": {"modes": 2, "noise": 0.01, "hold": 18, "dwell": 0}}, OBSERVATION),
        (TASK, {**OBSERVATION, "views": ["front"]}),
    ):
        with pytest.raises(UserError, match=r"was recorded with (noise|views)=.* is wanted; choose another"):
            collect(task, observation, demos(folder(recorded).parent))
    assert files(folder(recorded)) == before


def test_a_folder_without_its_log_is_refused(recorded):
    log = folder(recorded) / "collection.json"
    text = log.read_text()
    log.unlink()
    with pytest.raises(UserError, match=r"holds recordings, but no collection\.json .* restore it"):
        collect(TASK, OBSERVATION, demos(folder(recorded).parent))
    log.write_text(text)


def test_a_folder_without_recordings_takes_other_settings(played, tmp_path):
    for path in collect(TASK, OBSERVATION, demos(tmp_path, camera_every=4)).recordings.files:
        path.unlink()
    assert collect(TASK, OBSERVATION, demos(tmp_path)).num_new == 2


def test_failures_are_counted_left_out_and_not_tried_again(played, tmp_path):
    report = collect(TASK, OBSERVATION, demos(tmp_path, episodes=5))
    assert played == [0, 1, 2, 3, 4, 5, 6]
    assert (report.num_new, report.num_failed) == (5, 2)
    assert [path.name for path in report.recordings.files] == [
        f"episode-{seed:06d}.mcap" for seed in (0, 2, 3, 5, 6)
    ]
    assert json.loads((folder(report) / "collection.json").read_text())["failed_seeds"] == [1, 4]
    played.clear()
    report = collect(TASK, OBSERVATION, demos(tmp_path, episodes=6))
    assert played == [7]
    assert (report.num_new, report.num_failed) == (1, 2)


def test_the_seeds_used_do_not_depend_on_interruptions(played, tmp_path):
    for episodes in (1, 3):
        collect(TASK, OBSERVATION, demos(tmp_path, episodes=episodes))
    whole = folder(collect(TASK, OBSERVATION, demos(tmp_path, episodes=5)))
    assert files(whole) == [f"episode-{seed:06d}.mcap" for seed in (0, 2, 3, 5, 6)]


def test_the_seeds_of_the_band_can_run_out(played, tmp_path):
    with pytest.raises(UserError, match=r"demos.episodes=3 cannot be collected: .* end at 9999999"):
        collect(TASK, OBSERVATION, demos(tmp_path, episodes=3, first_seed=9_999_998))


def test_more_demonstrations_go_on_behind_the_seeds_of_evaluations(played, tmp_path):
    first = collect(TASK, OBSERVATION, demos(tmp_path, episodes=1, first_seed=9999))
    report = collect(TASK, OBSERVATION, demos(tmp_path, episodes=4, first_seed=9999))
    assert played == [9999, 1_000_000, 1_000_001, 1_000_002, 1_000_003]
    seeds = [9999, 1_000_000, 1_000_002, 1_000_003]  # from 1000001 the expert fails
    assert [path.name for path in report.recordings.files] == [f"episode-{seed:06d}.mcap" for seed in seeds]
    assert folder(report) == folder(first)
    assert recorded_seeds(folder(report)) == set(seeds)
    assert files(folder(report)) == [path.name for path in report.recordings.files]
    again = collect(TASK, OBSERVATION, demos(tmp_path, episodes=2, first_seed=1_000_000))
    assert (again.num_new, [path.name for path in again.recordings.files]) == (0, files(folder(report))[1:3])


def test_a_name_that_no_demonstration_has_is_no_demonstration(tmp_path):
    for name in (
        "episode-0000007.mcap",
        "episode-12345.mcap",
        "episode-000008.mcap",
        "episode-10000000.mcap",
    ):
        (tmp_path / name).touch()
    assert recorded_seeds(tmp_path) == {8}


@pytest.mark.parametrize(
    ("key", "value"),
    [("episodes", 0), ("first_seed", 10_000), ("first_seed", 999_999), ("camera_every", 0), ("workers", -1)],
)
def test_mistakes_are_named(key, value, tmp_path):
    with pytest.raises(UserError, match=f"^{key} must be "):
        collect(TASK, OBSERVATION, demos(tmp_path, **{key: value}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("views", []),
        ("views", ["front", "front"]),
        ("views", ["front", "side"]),
        ("views", "front"),
        ("image_size", [0, 32]),
        ("image_size", [32, -1]),
        ("image_size", [8, 8000]),
        ("image_size", [961, 8]),
        ("image_size", [32]),
    ],
)
def test_pictures_that_cannot_be_are_named_before_anything_is_written(key, value, tmp_path):
    with pytest.raises(UserError, match=f"observation.{key}"):
        collect(TASK, {**OBSERVATION, key: value}, demos(tmp_path / "demos"))
    assert not list(tmp_path.iterdir())


def test_a_damaged_log_is_named(played, tmp_path):
    directory = folder(collect(TASK, OBSERVATION, demos(tmp_path)))
    (directory / "collection.json").write_text("{")
    with pytest.raises(UserError, match=r"collection.json is damaged .* move .* away to record it again"):
        collect(TASK, OBSERVATION, demos(tmp_path))


def test_training_and_collecting_agree_on_what_is_wanted():
    train, alone = compose("train", ["task=socket"]), compose("collect", ["task=socket"])
    assert train["task"] == alone["task"]
    assert train["demos"] == {key: alone[key] for key in train["demos"]}
    for key in ("views", "image_size"):
        assert train["observation"][key] == alone["observation"][key]
