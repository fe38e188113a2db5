"""A config.yaml that is not what weights were trained with is refused; those of earlier versions are still known."""

import json
from pathlib import Path

import pytest
import yaml

from imfvla.config.assets import folder
from imfvla.errors import UserError
from imfvla.storage.run_directory import RunDirectory, digest_of_entries, flatten
from imfvla.storage.trained_config import digest_of_config, is_digest_of, refuse_changed_config, trained_data

CONFIG = {
    "name": "a",
    "horizon": {"exec": 16},
    "training": {"threads": 2, "compile": True, "sharding": "none"},
    "robot": {"state": ["x [m]"]},
}


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    run = RunDirectory(tmp_path / "run")
    run.weights_directory(3).mkdir(parents=True)
    (run.path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    return run


def keep(run: RunDirectory, **made: object) -> None:
    (run.weights_directory(3) / "policy.json").write_text(json.dumps(made))


def changed(**horizon: object) -> dict:
    return CONFIG | {"horizon": horizon}


def test_the_keys_that_differ_are_named(run):
    keep(run, config=CONFIG)
    refuse_changed_config(run, CONFIG, 3)
    with pytest.raises(
        UserError, match=r"weights of step 3 were trained with: horizon\.exec was 16, is 4\. Restore"
    ):
        refuse_changed_config(run, changed(exec=4), 3)


def test_how_a_run_executes_may_differ(run):
    keep(run, config=CONFIG, config_digest=digest_of_config(CONFIG))
    refuse_changed_config(run, CONFIG | {"training": {"threads": 1, "sharding": "full"}}, 3)


def test_a_digest_is_compared_where_there_is_no_config_and_beside_one(run):
    for made in ({}, {"config": changed(exec=4)}):
        keep(run, config_digest=digest_of_config(CONFIG), **made)
        with pytest.raises(UserError, match=r"policy\.json has config_digest [0-9a-f]{16}, found"):
            refuse_changed_config(run, changed(exec=4), 3)


def test_weights_that_say_nothing_are_not_compared(run):
    refuse_changed_config(run, changed(exec=4), 3)
    keep(run, step=3)
    refuse_changed_config(run, changed(exec=4), 3)
    assert trained_data(run, 3) is None


@pytest.mark.parametrize(
    "left_out",
    [
        ("evaluation", "training.threads"),
        ("evaluation", "training.threads", "training.compile"),
        ("evaluation", "training.threads", "training.compile", "training.sharding"),
    ],
)
def test_digests_of_earlier_versions_are_known(left_out):
    """They left out fewer keys."""
    digest = digest_of_entries(flatten(CONFIG), left_out)
    assert is_digest_of(CONFIG, digest)
    assert not is_digest_of(changed(exec=4), digest)


def test_the_shipped_policies_have_the_config_that_they_were_trained_with():
    for path in sorted(folder("experiments").glob("pretrained/*/*")):
        run = RunDirectory(path)
        config, step = run.config(), run.weights_step()
        refuse_changed_config(run, config, step)
        config["horizon"]["exec"] = 4
        with pytest.raises(UserError, match=r"horizon\.exec was 16, is 4|has config_digest \w+, found"):
            refuse_changed_config(run, config, step)
