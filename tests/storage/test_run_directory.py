import pytest

from imfvla.errors import UserError
from imfvla.storage.run_directory import DONE, RunDirectory, config_digest, differences

CONFIG = {
    "name": "a",
    "horizon": {"pred": 32, "views": ("x", "y")},
    "training": {"threads": None, "steps": 3},
}


def test_config_comes_back_plain(tmp_path):
    run = RunDirectory(tmp_path / "run")
    run.claim(CONFIG)
    assert run.config()["horizon"] == {"pred": 32, "views": ["x", "y"]}
    run.claim(CONFIG)


def test_other_config_is_refused_by_key(tmp_path):
    run = RunDirectory(tmp_path)
    run.claim(CONFIG, ignored=("training.threads",))
    run.metrics.write_text("")
    before = (tmp_path / "config.yaml").read_text()
    other = {
        **CONFIG,
        "horizon": {"pred": 16, "views": ["x", "y"]},
        "training": {"threads": 1, "steps": 3},
        "new": 1,
    }
    with pytest.raises(
        UserError, match=r"horizon\.pred was 32, is 16; new was absent, is 1\. Choose another name"
    ):
        run.claim(other, ignored=("training.threads",))
    assert (tmp_path / "config.yaml").read_text() == before


def test_another_config_takes_its_place_where_nothing_was_trained(tmp_path):
    run = RunDirectory(tmp_path)
    run.claim(CONFIG)
    run.keep_overrides(["seed=1"])
    run.claim({**CONFIG, "name": "b"})
    assert run.config()["name"] == "b"
    assert run.overrides() is None
    run.keep_overrides(["seed=2"])
    run.claim({**CONFIG, "name": "b"})
    assert run.overrides() == ["seed=2"]


def test_ignored_keys_may_differ():
    other = {**CONFIG, "training": {"threads": 8, "steps": 3}}
    assert differences(CONFIG, other, ("training.threads",)) == []
    assert differences(CONFIG, other, ("training",)) == []
    assert differences(CONFIG, other, ("train",)) == ["training.threads was None, is 8"]
    assert config_digest(CONFIG, ("training.threads",)) == config_digest(other, ("training.threads",))
    assert config_digest(CONFIG) != config_digest(other)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is not a run directory"),
        ("a: [", "cannot be read as YAML"),
        ("- 1", "must be a mapping of keys"),
    ],
)
def test_broken_config_is_reported(tmp_path, content, message):
    if content is not None:
        (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(UserError, match=message):
        RunDirectory(tmp_path).config()


def test_status(tmp_path):
    run = RunDirectory(tmp_path / "run")
    assert run.status() == {}
    run.write_status("running", step=3)
    run.write_status(DONE)
    assert run.status()["state"] == DONE
    assert "step" not in run.status()
    (run.path / "status.json").write_text("{")
    with pytest.raises(UserError, match=r"status\.json cannot be read"):
        run.status()


def test_one_process_at_a_time(tmp_path):
    run = RunDirectory(tmp_path)
    with run.lock(), pytest.raises(UserError, match="is in use by process"), RunDirectory(tmp_path).lock():
        pass
    with run.lock():
        pass


def test_weight_steps_are_those_that_are_whole(tmp_path):
    run = RunDirectory(tmp_path)
    assert run.weight_steps() == []
    for name in ("step-10", "step-9", "step-11.tmp", "last"):
        (run.checkpoints / name).mkdir(parents=True)
    assert run.weight_steps() == [9, 10]
    assert run.policy_weights().parent.name == "step-10"
    assert run.policy_weights(9).parent.name == "step-9"


def test_weights_of_a_share_of_the_training(tmp_path):
    run = RunDirectory(tmp_path)
    (run.checkpoints / "step-9").mkdir(parents=True)
    with pytest.raises(UserError, match=r"not a run directory"):
        run.policy_weights("1/3")
    run.claim({"training": {"steps": 26}})
    assert run.policy_weights("1/3").parent.name == "step-9"
    with pytest.raises(UserError, match=r"no weights of step 17: kept are 9"):
        run.policy_weights("2/3")


def test_reading_creates_nothing(tmp_path):
    run = RunDirectory(tmp_path / "absent")
    assert run.weight_steps() == []
    assert run.status() == {}
    assert not run.path.exists()
