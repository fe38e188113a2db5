"""The campaign: which policies it trains, that finished ones are not repeated, and that a failure stops no other."""

import re
import runpy
import subprocess
import sys
import types
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import synthetic_runs
import yaml

from imfvla.command.planning import jobs_of_rows
from imfvla.errors import UserError
from imfvla.reporting.mapping import read_mapping
from imfvla.storage.files import write_json
from imfvla.storage.run_directory import DONE, RunDirectory

PATH = Path(__file__).parents[2] / "tools" / "campaign.py"
TOOL = types.SimpleNamespace(**runpy.run_path(str(PATH)))
STEPS = 6000


class Pretended(TOOL.Campaign):
    """Leaves what a training would leave, in no time; trainings of `broken` names fail."""

    def __init__(self, broken: str = "none", **options) -> None:
        super().__init__(**({"side_by_side": 2, "commit": False} | options))
        self.broken, self.trained = broken, []

    def _train(self, policy, overrides) -> int:
        self.trained.append(policy.name)
        if self.broken in policy.name:
            return 2
        run = RunDirectory(policy.directory)
        config = next(job.config for job in policy.jobs if job.overrides == overrides)
        synthetic_runs.make_run(run.path, config["name"], steps=STEPS)
        (run.path / "config.yaml").write_text(yaml.safe_dump(config))
        for step in (STEPS // 3, STEPS):
            weights = run.weights_directory(step) / "policy.safetensors"
            fingerprint = {"code": {"commit": "abc"}, "machine": {}}
            write_json(
                weights.with_suffix(".json"), {"step": step, "train_s": 1.0, "fingerprint": fingerprint}
            )
            weights.write_bytes(b"weights")
        at = STEPS // 3 if config["evaluation"]["checkpoint"] == "1/3" else STEPS
        for nfe in config["evaluation"]["nfe"]:
            synthetic_runs.write_evaluation(run.path, nfe, number=100, step=at)
        run.write_status(DONE)
        return 0


@pytest.fixture
def policies(tmp_path):
    """Three policies of the campaign, below `tmp_path`."""
    found = TOOL.policies("campaign", "socket_", tmp_path / "results")
    return [replace(policy, directory=tmp_path / policy.directory) for policy in found[:3]]


def test_it_trains_every_policy_of_the_tables_once_and_the_unimodal_ones():
    found = TOOL.policies("campaign")
    names = [policy.name for policy in found]
    assert len(set(names)) == len(names) == 34
    printed = [row for row in read_mapping().rows if row.table in ("table1", "table2")]
    assert {f"{row.experiment}/{row.run or 'default'}" for row in printed} <= {*names}
    assert sum("task.expert.modes=1" in name for name in names) == 8
    (headline,) = (policy for policy in found if policy.name == "socket_ph32_exec16/generator=imf_plain")
    assert [job.config["evaluation"]["checkpoint"] for job in headline.jobs] == ["1/3", "last", "last"]


def test_what_is_kept_is_not_run_again(policies):
    campaign = Pretended()
    assert campaign.run(policies) == []
    assert all(policy.is_done for policy in policies)
    first = policies[0]
    assert not list(first.target.rglob("*.safetensors"))
    (infer2,) = first.target.glob("rollouts/*_nfe2_*")
    (infer2 / "summary.json").unlink()
    assert [policy.is_done for policy in policies] == [False, True, True]
    assert campaign.run([first]) == []
    assert first.is_done


def test_another_config_is_not_what_was_asked_for(policies):
    Pretended().run(policies)
    path = policies[1].target / "config.yaml"
    path.write_text(path.read_text().replace("steps: 6000", "steps: 600"))
    assert [policy.is_done for policy in policies] == [True, False, True]


def test_a_failure_is_reported_and_ends_no_other_policy(policies):
    (failure,) = Pretended(broken="ddpm_ph16").run(policies)
    assert "imfvla.train +exp=socket_ddpm_ph16" in failure
    assert failure.endswith("ended with exit code 2; see runs/campaign/socket_ddpm_ph16,default.log.")
    assert [policy.is_done for policy in policies] == [True, False, True]


def test_each_result_is_committed_alone(policies, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for key, value in {"NAME": "A", "EMAIL": "a@b.c"}.items():
        for who in ("AUTHOR", "COMMITTER"):
            monkeypatch.setenv(f"GIT_{who}_{key}", value)
    subprocess.run(["git", "init", "--quiet"], check=True)
    (tmp_path / "notes.txt").write_text("not to be committed")
    Pretended(commit=True).run(policies)
    log = subprocess.run(["git", "log", "--format=%s", "--name-only"], capture_output=True, text=True).stdout
    for policy in policies:
        assert f"Add the result of {policy.name}\n" in log
        assert f"results/{policy.name}/made_by.json" in log
    assert "notes.txt" not in log
    assert "safetensors" not in log


def test_a_whole_name_means_that_policy_alone():
    name = "socket_ph32_exec16/generator=l1"
    assert [policy.name for policy in TOOL.policies("campaign", name)] == [name]
    assert len(TOOL.policies("campaign", name[:-1])) == 2


def test_a_name_that_fits_nothing_is_reported_with_those_there_are():
    with pytest.raises(
        UserError, match=r"--only knitting matches none .*: socket_ph32_exec16/generator=imf_plain, "
    ):
        TOOL.policies("campaign", "knitting")


def test_the_list_runs_nothing(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["campaign.py", "--list", "--only", "socket_act"])
    none_is_done = partial(TOOL.policies, results=tmp_path)
    monkeypatch.setitem(TOOL.main.__wrapped__.__globals__, "policies", none_is_done)
    assert TOOL.main() == 0
    assert capsys.readouterr().out.startswith("open  python -m imfvla.train +exp=socket_act evaluation.")


def test_the_readme_of_the_experiments_names_the_command_of_every_row():
    text = (PATH.parents[1] / "experiments" / "README.md").read_text()
    usual = re.compile(r" evaluation\.(first_seed|episodes|noise_seed|device)=\S+")
    rows = [row for row in read_mapping().rows if not row.changes]  # the others are evaluations of these
    for job in jobs_of_rows(rows):
        assert f"`python -m imfvla.train {usual.sub('', ' '.join(job))}`" in text
    assert all(f"`{row.name}`" in text for row in rows)
