"""The command's two ways to say which demonstrations are wanted."""

import pytest

from imfvla import collect
from imfvla.recording import Recordings
from imfvla.sources import collection


@pytest.fixture
def asked(monkeypatch, tmp_path) -> list[tuple]:
    """The task, observation and demos of each collection, which is not made."""
    monkeypatch.chdir(tmp_path)
    calls = []

    def record(*arguments):
        calls.append(arguments)
        return collection.Report(Recordings.named(tmp_path, [], "none"), 0, 0, 0.0)

    monkeypatch.setattr(collection, "collect", record)
    return calls


def test_an_experiment_says_task_pictures_and_demonstrations(asked, tmp_path):
    collect.main(["+exp=transfer_dwell", "demos.episodes=3"])
    ((task, observation, demos, where),) = asked
    assert (task["name"], task["expert"]["dwell"], task["expert"]["modes"]) == ("transfer", 26, 1)
    assert (observation["image_size"], demos["episodes"], where) == ([96, 96], 3, "demos")
    assert list(tmp_path.iterdir()) == []


def test_without_one_the_options_are_at_the_top(asked, tmp_path):
    collect.main(["task=gate", "episodes=3"])
    ((task, _, demos, where),) = asked
    assert (task["name"], demos["episodes"], where) == ("gate", 3, "")
    assert list(tmp_path.iterdir()) == []


def test_a_mistake_in_either_is_one_sentence(asked, capsys):
    for arguments, message in (
        (["+exp=transfer_dwel"], "Unknown exp 'transfer_dwel'"),
        (["+exp=gate", "episodes=3"], "Unknown key episodes"),
    ):
        with pytest.raises(SystemExit, match="2"):
            collect.main(arguments)
        assert message in capsys.readouterr().err
    assert asked == []
