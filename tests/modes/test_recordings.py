"""Which demonstrations a run was not trained on, and what is refused."""

import json

import pytest
from synthetic import VIEWS, write_episode

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.modes import recordings
from imfvla.modes.recordings import choose_recordings, read_demonstration, record_starts, settings_of
from imfvla.sources.collection import LOG_NAME, recording_path

CONFIG = compose("train", ["+exp=socket_ph32_exec16", "demos.episodes=3", "observation.image_size=[32,32]"])


@pytest.fixture
def folder(tmp_path):
    for seed in (0, 1, 3, 4, 5):
        recording_path(tmp_path, seed).touch()
    (tmp_path / LOG_NAME).write_text(json.dumps({"settings": {}, "failed_seeds": [2]}))
    return tmp_path


def seeds(paths):
    return [int(path.stem.split("-")[1]) for path in paths]


def test_demonstrations_of_the_training_are_left_out(folder):
    assert seeds(choose_recordings(CONFIG, folder, None, 10)) == [4, 5]  # 2 failed, so that 3 was trained on
    assert seeds(choose_recordings(CONFIG, folder, 5, 10)) == [5]
    assert seeds(choose_recordings(CONFIG, folder, None, 1)) == [4]


def test_a_folder_without_what_is_wanted_is_refused(folder, tmp_path):
    with pytest.raises(UserError, match=r"--first-seed must be .* found 3: trained on were 0 to 3"):
        choose_recordings(CONFIG, folder, 3, 10)
    with pytest.raises(UserError, match=r"no demonstration from seed 6 on .* seeds 0 to 5"):
        choose_recordings(CONFIG, folder, 6, 10)
    with pytest.raises(UserError, match=r"No demonstrations .* correct --demos"):
        choose_recordings(CONFIG, tmp_path / "nowhere", None, 10)


def test_a_run_from_before_a_setting_is_read_as_it_was(folder):
    expert = {
        key: value for key, value in CONFIG["task"]["expert"].items() if key not in ("dwell", "recoveries")
    }
    old = {**CONFIG, "task": {**CONFIG["task"], "expert": expert}}
    assert settings_of(old) == settings_of(CONFIG)


def test_recordings_of_another_task_or_size_are_refused(tmp_path):
    settings = settings_of(CONFIG)
    write_episode(tmp_path / "good.mcap", 0)
    assert set(read_demonstration(tmp_path / "good.mcap", settings).images) == set(VIEWS)
    write_episode(tmp_path / "task.mcap", 0, task="transfer")
    with pytest.raises(UserError, match="task='transfer', the run is of task='socket'"):
        read_demonstration(tmp_path / "task.mcap", settings)
    write_episode(tmp_path / "size.mcap", 0, image_size=(16, 16))
    with pytest.raises(UserError, match=r"image_size=\[16, 16\], the run is of image_size=\[32, 32\]"):
        read_demonstration(tmp_path / "size.mcap", settings)


def test_the_expert_plays_what_is_missing_and_failures_are_replaced(tmp_path, monkeypatch):
    played = []

    def record(settings, directory, seed):
        played.append(seed)
        if seed != 10_001:
            recording_path(directory, seed).touch()
        return seed, seed != 10_001

    monkeypatch.setattr(recordings, "record_demonstration", record)
    (tmp_path / "socket-default-modes2-32x32").mkdir()
    assert seeds(record_starts(CONFIG, tmp_path, 10_000, 3)) == [10_000, 10_002, 10_003]
    assert seeds(record_starts(CONFIG, tmp_path, 10_000, 3)) == [10_000, 10_002, 10_003]
    assert played == [10_000, 10_001, 10_002, 10_003, 10_001]
    with pytest.raises(UserError, match="are for reporting, found 100000"):
        record_starts(CONFIG, tmp_path, 100_000, 3)
    with pytest.raises(UserError, match="found 1: trained on were 0 to 2"):
        record_starts(CONFIG, tmp_path, 1, 3)


def test_a_run_of_another_task_has_no_hidden_choice_that_is_known():
    for task in (
        {"name": "none", "paraphrases": False},
        {"name": "pusht", "kind": "gymnasium", "expert": None},
    ):
        with pytest.raises(UserError, match=rf"own tasks, found task={task['name']} of task\.kind="):
            settings_of(CONFIG | {"task": task})
