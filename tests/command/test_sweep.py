"""Sweeps: what their files ask for, that a killed one resumes, and that one failure ends no other job."""

import json
from functools import cache
from pathlib import Path
from unittest import mock

import pytest
import tiny_sweep

from imfvla.command.completion import is_complete
from imfvla.command.composition import CONFIG_DIRECTORY
from imfvla.command.planning import Planned, jobs_of_rows
from imfvla.command.sweep import _Sweep, waves
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.rows import untimed
from imfvla.storage.run_directory import DONE, LAST, RunDirectory
from imfvla.storage.run_names import run_key, run_name

MAPPING = read_mapping()
FILES = sorted(path.stem for path in (CONFIG_DIRECTORY / "sweep").glob("*.yaml"))
JOBS = ["-m", "seed=0,1", "core=attnres,standard", *tiny_sweep.OVERRIDES]


@cache
def planned_by(name: str) -> list[Planned]:
    """The jobs of a file of conf/sweep, which are not run."""
    with mock.patch("imfvla.command.sweep._Sweep.run", return_value=[]) as run:
        tiny_sweep.main([f"+sweep={name}"])
    return run.call_args.args[0]


@pytest.mark.parametrize("name", FILES)
def test_every_file_has_jobs_in_directories_that_their_overrides_name(name):
    planned = planned_by(name)
    assert len({job.overrides for job in planned}) == len(planned) >= 4
    for job in planned:
        assert job.directory == Path("runs") / job.config["name"] / run_name(job.overrides)
        assert max(job.config["evaluation"]["nfe"]) >= 1


def test_sweeps_answer_every_row_of_the_tables():
    planned = [job for name in ("socket", "transfer", "dwell", "aloha") for job in planned_by(name)]
    second_campaign = planned_by("campaign_seeds")
    of_one_seed = {f"socket800_{name}" for name in ("l2", "act", "act_latent", "smolvla_flow")}
    for row in MAPPING.rows:
        is_second = "demos.episodes=800" in row.overrides
        of_run = [
            job.config["evaluation"]
            for job in (second_campaign if is_second else planned)
            if (job.directory.parent.name, run_key(job.directory.name)) == (row.experiment, row.run)
        ]
        answers = [e for e in of_run if row.nfe in e["nfe"] and e["checkpoint"] == row.checkpoint]
        has_seeds = row.name not in of_one_seed if is_second else row.experiment == "transfer_dwell"
        assert len(answers) == (3 if has_seeds else 1), row.name  # training seeds
        assert all(answers[0][name] == getattr(row.wanted, name) for name in row.wanted.__slots__)


def test_the_grid_of_horizons_is_all_that_can_be_executed():
    horizons = [job.config["horizon"] for job in planned_by("horizon")]
    sizes = (8, 16, 32)
    wanted = {(pred, exec_) for pred in sizes for exec_ in sizes if exec_ <= pred}
    assert sorted((horizon["pred"], horizon["exec"]) for horizon in horizons) == sorted(wanted)


def test_evaluations_and_demonstrations_are_counted_as_they_say():
    for job in planned_by("evaluations"):
        assert job.config["evaluation"]["nfe"] == list(range(1, 11))
    numbers = [job.config["demos"]["episodes"] for job in planned_by("demonstrations")]
    assert sorted(numbers) == [25, 25, 50, 50, 100, 100, 200, 200]


def test_jobs_of_one_directory_never_run_at_the_same_time():
    jobs = [Planned((name,), {}, Path("runs", name[0])) for name in ("a1", "b1", "a2", "c1", "a3", "b2")]
    assert [[job.overrides[0] for job in wave] for wave in waves(jobs)] == [
        ["a1", "b1", "c1"],
        ["a2", "b2"],
        ["a3"],
    ]
    assert [len(wave) for wave in waves([Planned((str(i),), {}, Path()) for i in range(3)])] == [3]


def test_rows_of_one_run_and_its_weights_are_one_job():
    rows = [row for row in MAPPING.rows if row.run == "generator=imf_plain" and row.table == "table1"]
    jobs = jobs_of_rows(rows)
    assert [(*job[:2], job[-1]) for job in jobs] == [
        ("+exp=socket_ph32_exec16", "generator=imf_plain", "evaluation.nfe=[1]"),
        ("+exp=socket_ph32_exec16", "generator=imf_plain", "evaluation.nfe=[2,3]"),
    ]
    assert ["evaluation.checkpoint=1/3" in job for job in jobs] == [
        row.checkpoint != LAST for row in rows[:2]
    ]


@pytest.fixture
def jobs(synthetic_demonstrations) -> list[str]:
    return [*JOBS, f"demos.directory={synthetic_demonstrations}"]


def test_a_sweep_killed_in_the_middle_resumes_and_ends_as_an_undisturbed_one(jobs, tmp_path, monkeypatch):
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    for directory in (undisturbed, killed):
        directory.mkdir()
    monkeypatch.chdir(undisturbed)
    tiny_sweep.main(jobs)

    assert tiny_sweep.launch(jobs, killed, TINY_KILL_AT="4").returncode == -9
    states = [RunDirectory(path.parent).status()["state"] for path in killed.rglob("config.yaml")]
    assert sorted(states) == ["done", "running"]
    first = next(killed.rglob("summary.json"))
    before = first.stat().st_mtime_ns
    monkeypatch.chdir(killed)
    tiny_sweep.main(jobs)
    assert first.stat().st_mtime_ns == before

    updates = [
        (directory / tiny_sweep.UPDATES).read_text().splitlines() for directory in (undisturbed, killed)
    ]
    assert len(updates[1]) == len(set(updates[1])) == 4 * 2  # none twice
    assert updates[0] == updates[1]
    for path in sorted(undisturbed.rglob("episodes.jsonl")):
        twin = killed / path.relative_to(undisturbed)
        rows, twins = ([untimed(json.loads(line)) for line in p.open()] for p in (path, twin))
        assert rows == twins
        protocols = [json.loads((p.parent / "summary.json").read_text())["protocol"] for p in (path, twin)]
        assert protocols[0] == protocols[1]  # with the digest of the weights
    assert tiny_sweep.untimed_table(undisturbed) == tiny_sweep.untimed_table(killed)
    assert len(tiny_sweep.untimed_table(killed)) == 2  # both seeds of a policy are one row


def test_one_failure_ends_no_other_job_and_finished_ones_are_skipped(jobs, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    arguments = [text.replace("seed=0,1", "seed=13,0").replace("core=attnres,", "core=") for text in jobs]
    for finished in (0, 1):
        with pytest.raises(SystemExit) as exit_:
            tiny_sweep.main(arguments)
        assert exit_.value.code == 2
        printed = capfd.readouterr().err
        assert printed.endswith(
            f"of which {finished} were finished before, {1 - finished} ran and 1 failed.\nseed 13 is bad.\n"
        )
    assert "Finished already: runs/socket/core=standard,observation" in printed
    assert len((tmp_path / tiny_sweep.UPDATES).read_text().splitlines()) == 2


def test_a_run_is_complete_with_every_evaluation_that_is_asked_for(jobs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny_sweep.main([text.replace("0,1", "0").replace("attnres,", "") for text in jobs[1:]])
    (path,) = (tmp_path / "runs" / "socket").iterdir()
    run = RunDirectory(path)
    config = run.config()
    assert run.status()["state"] == DONE
    assert is_complete(config, path)
    for key, value in {"nfe": [1, 2], "episodes": 3, "noise_seed": 1, "checkpoint": 1}.items():
        assert not is_complete(config | {"evaluation": config["evaluation"] | {key: value}}, path)
    assert not is_complete(config | {"seed": 1}, path)
    assert not is_complete(config, tmp_path)
    next(path.rglob("summary.json")).write_text("{")
    assert not is_complete(config, path)


def test_a_launcher_that_fails_is_reported_once_and_what_has_finished_counts(tmp_path):
    launcher = mock.Mock()
    planned = [Planned((name,), {}, tmp_path / name) for name in ("a", "b", "c")]
    sweep = _Sweep(launcher, False, "train", lambda config, directory: directory.exists())
    launcher.launch.side_effect = lambda *_, **__: (tmp_path / "b").mkdir() or 1 / 0
    failures = sweep.run(planned)
    assert [failure.overrides for failure in failures] == ["a", "c"]
    assert failures[0].text.endswith("ZeroDivisionError: division by zero")
    assert failures[1].text == "Not finished, for the same reason."


class UncompletedJobError(Exception):
    """As submitit calls it."""


def test_a_job_that_was_killed_elsewhere_is_told_in_a_sentence(tmp_path):
    launcher = mock.Mock()
    planned = [Planned((name,), {}, tmp_path / name) for name in ("a", "b")]
    launcher.launch.side_effect = UncompletedJobError(
        "Job 7 has not\nproduced any output\nError stream: 1000 lines"
    )
    one, other = _Sweep(launcher, False, "train", lambda config, directory: False).run(planned)
    assert one.text.startswith(
        "A job ended without a result, as one does that is killed (Job 7 has not produced any output). Rerun"
    )
    assert other.text == "Not finished yet; it may still be running."
    assert one.is_user_error
    assert other.is_user_error


def test_an_unknown_launcher_is_reported_with_where_it_comes_from(capfd):
    with pytest.raises(SystemExit):
        tiny_sweep.main(["-m", "seed=0,1", "hydra/launcher=submitit_slrm"])
    printed = capfd.readouterr().err
    assert printed.startswith("Unknown launcher 'submitit_slrm': known here are basic")
    assert "pip install -e '.[slurm]'" in printed


@pytest.mark.parametrize("name", ["socke", "table"])
def test_an_unknown_sweep_is_reported(name, capfd):
    with pytest.raises(SystemExit) as exit_:
        tiny_sweep.main([f"+sweep={name}"])
    assert exit_.value.code == 2
    assert capfd.readouterr().err.startswith(f"Unknown sweep {name!r}")
