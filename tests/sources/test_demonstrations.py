"""What a folder of demonstrations is named after and checked by, without playing any."""

import pytest

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.gymnasium_env.experts import make_expert
from imfvla.modes.recordings import settings_of as settings_of_run
from imfvla.sources.demonstrations import settings_of


def settings(task: str, *overrides: str, camera_every: int = 4):
    config = compose("train", [f"task={task}", *overrides])
    return settings_of(config["task"], config["observation"], camera_every, "demos.camera_every")


ALOHA = ("observation.views=[top]", "observation.image_size=[48,64]")


def test_folders_are_named_after_task_and_pictures():
    assert settings("socket").folder == "socket-default-modes2-96x96"
    assert settings("transfer", "task.expert.dwell=26").folder == "transfer-default-modes2-dwell26-96x96"
    assert (
        settings("socket", "task.expert.recoveries=0.3").folder == "socket-default-modes2-recoveries0.3-96x96"
    )
    assert settings("socket", "task.expert.max_turn=0.1").folder == "socket-default-modes2-turn0.1-96x96"
    assert settings("aloha_transfer", *ALOHA).folder == "aloha_transfer-48x64"


@pytest.mark.parametrize(("key", "value"), [("recoveries", 0.3), ("max_turn", 0.1)])
def test_recordings_without_a_newer_setting_say_what_they_said_before_there_was_any(key, value):
    usual, asked = settings("socket"), settings("socket", f"task.expert.{key}={value}")
    assert asked.to_json() == usual.to_json() | {key: value}
    assert key not in usual.to_json()


def test_whatever_changes_the_recordings_changes_the_settings():
    usual = settings("aloha_transfer", *ALOHA)
    assert usual == settings("aloha_transfer", *ALOHA, "task.paraphrases=true")
    assert usual.to_json()["task.expert.noise"] == 0.004
    changed = [
        settings("aloha_transfer", *ALOHA, f"task.{key}") for key in ("expert.noise=0", "instruction=go")
    ]
    assert usual not in changed
    assert settings("aloha_transfer", *ALOHA, camera_every=2) != usual
    assert len({usual, *changed}) == 3


@pytest.mark.parametrize(
    ("task", "camera_every", "named"),
    [
        ("socket", 701, "demos.camera_every must be between 1 and 700"),
        ("aloha_transfer", 401, "demos.camera_every must be between 1 and 400"),
        ("pusht", 1, "task.expert is null: pusht has no scripted expert"),
    ],
)
def test_what_cannot_be_demonstrated_is_named(task, camera_every, named):
    views = () if task == "socket" else ALOHA
    with pytest.raises(UserError, match=named):
        settings(task, *views, camera_every=camera_every)


def test_an_expert_that_nobody_has_is_refused():
    with pytest.raises(UserError, match=r"task\.expert must be null"):
        make_expert({"package": "gym_pusht", "expert": {"noise": 0}})


def test_a_hidden_choice_is_looked_for_in_our_own_tasks_alone():
    with pytest.raises(UserError, match=r"one of this package's own tasks"):
        settings_of_run(compose("train", ["task=aloha_transfer", *ALOHA]))
