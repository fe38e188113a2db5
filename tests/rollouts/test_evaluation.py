"""Evaluations: equal seeds give equal bytes, a killed one resumes, a finished one is left alone."""

import json
import os
import re
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from fakes import FakeEnvironment, KnownPolicy, build_fakes

from imfvla.config.condition import ConditionOptions
from imfvla.config.protocol import USUAL, EvaluationOptions, Protocol
from imfvla.errors import UserError
from imfvla.evaluate import main, read_nfe
from imfvla.reporting.rows import TIMING
from imfvla.reporting.runs import evaluations, rows
from imfvla.reporting.table_row import table_of
from imfvla.rollouts import workbench
from imfvla.rollouts.evaluation import best_median_worst, evaluate
from imfvla.rollouts.latency import latency_of
from imfvla.rollouts.rollout_log import PARTIAL
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy

NAME = "seeds100000-100005_nfe1"


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    """A run directory with two checkpoints, whose bytes nobody reads as tensors."""
    run = RunDirectory(tmp_path / "runs" / "fake" / "default")
    for step in (10, 20):
        run.weights_directory(step).mkdir(parents=True)
        (run.weights_directory(step) / "policy.safetensors").write_bytes(b"weights of step %d" % step)
    config = {
        "name": "fake",
        "task": {"name": "fake", "variant": "default"},
        "observation": {"views": ["front"], "image_size": [16, 16]},
        "horizon": {"obs": 1, "pred": 8, "exec": 4},
    }
    (run.path / "config.yaml").write_text(yaml.safe_dump(config))
    return run


@pytest.fixture(autouse=True)
def fresh_workbench():
    workbench._bench.cache_clear()


def roll(run: RunDirectory, **options) -> list[dict]:
    defaults = {"episodes": 6, "first_seed": 100_000, "nfe": (1,), "workers": 0, "recordings": False}
    make = options.pop("build", build_fakes)
    return evaluate(run, EvaluationOptions(**{**defaults, **options}), build=make)


def untimed_lines(folder: Path) -> list[str]:
    """The lines of episodes.jsonl up to the times, which stand last."""
    lines = (folder / "episodes.jsonl").read_text().splitlines()
    return [line.split(f'"{TIMING}"')[0] for line in lines]


def test_rows_and_summary(run):
    (summary,) = roll(run)
    folder = run.rollouts(NAME)
    rows = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    assert [row["seed"] for row in rows] == list(range(100_000, 100_006))
    assert [row["max_reward"] for row in rows] == [seed % 4 for seed in range(100_000, 100_006)]
    assert all(list(row)[-1] == TIMING and len(row[TIMING]["inference_ms"]) == 10 for row in rows)
    assert summary == json.loads((folder / "summary.json").read_text())
    assert summary["episodes"] == 6
    assert (summary["success_episodes"], summary["nonzero_episodes"]) == (1, 4)
    assert summary["max_return"] == max(row["total_reward"] for row in rows)
    assert summary["seeds"] == [100_000, 100_005]
    assert summary["checkpoint_step"] == summary["protocol"]["checkpoint_step"] == 20
    assert summary["fingerprint"]["threads"] == 1
    assert summary["fingerprint"]["gl_renderer"] == "no renderer"
    assert not (folder / PARTIAL).exists()


def test_equal_seeds_give_equal_bytes_but_for_the_times(run, tmp_path):
    roll(run, nfe=(1, 2))
    first = {name: untimed_lines(run.rollouts(name)) for name in (NAME, "seeds100000-100005_nfe2")}
    roll(run, nfe=(2, 1), overwrite=True)
    assert first == {name: untimed_lines(run.rollouts(name)) for name in first}


def test_workers_change_nothing(run):
    roll(run)
    here = untimed_lines(run.rollouts(NAME))
    roll(run, workers=1, overwrite=True)
    assert untimed_lines(run.rollouts(NAME)) == here


def test_a_killed_evaluation_resumes_where_it_stopped(run, monkeypatch):
    roll(run)
    uninterrupted = untimed_lines(run.rollouts(NAME))
    played = left_over(run, monkeypatch, rows=3, overwrite=True)
    partial = run.rollouts(NAME) / PARTIAL
    with open(partial, "a") as file:
        file.write('{"seed": 100003, "sta')  # the line that the kill cut off
    roll(run, overwrite=True)
    assert played == [100_000, 100_001, 100_002, 100_003, 100_003, 100_004, 100_005]
    assert untimed_lines(run.rollouts(NAME)) == uninterrupted


def test_a_finished_evaluation_is_left_alone_until_the_weights_change(run):
    (first,) = roll(run)
    before = (run.rollouts(NAME) / "episodes.jsonl").stat().st_mtime_ns
    assert roll(run) == [first]
    assert (run.rollouts(NAME) / "episodes.jsonl").stat().st_mtime_ns == before
    (run.weights_directory(20) / "policy.safetensors").write_bytes(b"trained further")
    (again,) = roll(run)
    assert again["protocol"]["weights"] != first["protocol"]["weights"]


@pytest.mark.parametrize(
    "left", ['{"protocol": {"weights": "0123"}}\n{"seed": 100000, "foreign": true}\n', "{damaged\n"]
)
def test_rows_of_other_weights_are_not_mixed_in(run, left):
    run.rollouts(NAME).mkdir(parents=True)
    (run.rollouts(NAME) / PARTIAL).write_text(left)
    roll(run)
    assert "foreign" not in (run.rollouts(NAME) / "episodes.jsonl").read_text()


def test_best_median_and_worst_are_recorded_as_they_were_rolled_out(run):
    (summary,) = roll(run, recordings=True)
    assert {label: recording["seed"] for label, recording in summary["recordings"].items()} == {
        "best": 100_003, "median": 100_001, "worst": 100_004,
    }  # fmt: skip
    for recording in summary["recordings"].values():
        path = run.rollouts(NAME) / recording["file"]
        assert path.stat().st_size > 0
        assert path.with_suffix(".mp4").stat().st_size > 0


def test_an_episode_that_plays_differently_the_second_time_is_an_error(run, monkeypatch):
    draws = iter(range(100))
    monkeypatch.setattr(FakeEnvironment, "start_digest", lambda self: str(next(draws)))
    with pytest.raises(RuntimeError, match="played twice differs"):
        roll(run, recordings=True, episodes=1)


def test_best_median_and_worst_of_few_episodes():
    rows = [{"seed": seed, "total_reward": reward} for seed, reward in [(1, 5.0), (2, 5.0), (3, 0.0)]]
    assert {label: row["seed"] for label, row in best_median_worst(rows).items()} == {
        "best": 1, "median": 2, "worst": 3,
    }  # fmt: skip
    assert list(best_median_worst(rows[:1])) == ["best"]


@pytest.mark.parametrize("value", ["1,2,3", [1, 2, 3], ["1", 2, "3"]])
def test_nfe_is_read_from_texts_and_lists(value):
    assert read_nfe(value) == [1, 2, 3]
    assert read_nfe(2) == [2]


@pytest.mark.parametrize("value", [0, "0", "1,x", [], "", 1.5, True, None, "1,-2"])
def test_a_wrong_nfe_is_named(value):
    with pytest.raises(UserError, match="nfe must be one or more whole numbers of at least 1"):
        read_nfe(value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "evaluate needs the directory of a training run: run="),
        (["run={tmp}/nothing"], "is not a run directory: it has no config.yaml"),
        (["run={run}", "nfe=1,0"], "nfe must be one or more whole numbers"),
        (["run={run}", "episodes=0"], "episodes must be between 1 and 50000, found 0"),
        (["run={run}", "episodes=many"], "episodes must be a whole number, found 'many'"),
        (["run={run}", "device=gpu"], "device must be one of cpu, cuda, found 'gpu'"),
        (["run={run}", "checkpoint=15"], "has no weights of step 15: kept are 10, 20, or take last"),
        (["run={run}", "episode=3"], "Unknown key episode (did you mean episodes?)"),
    ],
)
def test_a_wrong_command_says_what_to_do(run, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as exit_:
        main([text.format(tmp=tmp_path, run=run.path) for text in arguments])
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (run.path / "rollouts").exists()


def test_a_directory_is_taken_as_it_is(run, tmp_path, capsys):
    named = tmp_path / "it's,training.steps=3"
    run.path.rename(named)
    with pytest.raises(SystemExit):
        main([f"run={named}", "checkpoint=15"])
    assert f"{named}/checkpoints has no weights of step 15" in capsys.readouterr().err


def test_a_run_without_weights_is_named(run):
    for path in run.checkpoints.glob("*/*"):
        path.unlink()
    for path in run.checkpoints.glob("*"):
        path.rmdir()
    with pytest.raises(UserError, match="has no weights in checkpoints"):
        roll(run)


def test_other_weights_noise_and_lengths_have_folders_of_their_own(run):
    (summary,) = roll(run, checkpoint=10, noise_seed=3, noise_scale=0.5, max_steps=5)
    assert summary["name"] == "seeds100000-100005_nfe1_step10_noise3_scale0.5_max5"
    assert summary["protocol"]["weights"] != roll(run)[0]["protocol"]["weights"]
    assert sorted(path.name for path in run.path.glob("rollouts/*")) == [NAME, summary["name"]]


def test_an_evaluation_from_before_noise_had_a_scale_is_not_repeated(run):
    (summary,) = roll(run)
    path = run.rollouts(NAME) / "summary.json"
    del summary["protocol"]["noise_scale"], summary["description_digest"]
    path.write_text(json.dumps(summary))
    summary["protocol"]["noise_scale"] = 1.0
    assert roll(run) == [summary]


@pytest.mark.parametrize("workers", [0, 1])
def test_weights_that_are_no_tensors_are_named_and_nothing_is_left_behind(run, workers):
    with pytest.raises(UserError, match="lacks the key 'action_frame'"):
        roll(run, episodes=1, first_seed=0, workers=workers, build=load_policy_alone)
    assert not list(run.path.glob("rollouts/*"))


def load_policy_alone(path: Path, step: int) -> tuple:
    """A `workbench.Build` without a simulator, for a run whose config is no policy's."""
    return None, load_policy(RunDirectory(path), step)


def test_a_config_of_something_else_is_named(run):
    (run.path / "config.yaml").write_text("name: other\ntask: {name: socket}\n")
    with pytest.raises(UserError, match=r"lacks observation\.views, observation\.image_size"):
        roll(run)


def test_two_evaluations_do_not_write_into_one_folder(run):
    from imfvla.rollouts.rollout_log import RolloutLog

    with RolloutLog(run.rollouts(NAME), {}), pytest.raises(UserError, match="in use by another evaluation"):
        roll(run)


def test_known_policies_are_reset_between_episodes(run):
    roll(run)
    _, policy = workbench._bench(build_fakes, run.path, 20, "none", None)
    assert isinstance(policy, KnownPolicy)
    assert [steps[0] for steps in policy.seen[:11]] == [*range(0, 40, 4), 0]


def build_that_dies_once(run: Path, step: int) -> tuple:
    """A `workbench.Build` whose first process is gone in the middle of its third episode."""
    env, policy = build_fakes(run, step)
    reset, played = env.reset, []

    def dies(seed: int) -> object:
        played.append(seed)
        if len(played) == 3 and not (run / "died").exists():
            (run / "died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return reset(seed)

    env.reset = dies
    return env, policy


def test_the_episode_of_a_worker_that_died_is_played_again_and_counted(run):
    (undisturbed,) = roll(run)
    before = untimed_lines(run.rollouts(NAME))
    (summary,) = roll(run, build=build_that_dies_once, workers=1, overwrite=True)
    assert untimed_lines(run.rollouts(NAME)) == before
    assert (undisturbed["worker_incidents"], summary["worker_incidents"]) == (0, 1)


def left_over(run: RunDirectory, monkeypatch, rows: int = 2, **options) -> list[int]:
    """The seeds that are played from now on, with so many rows of an interrupted evaluation left."""
    played: list[int] = []
    original = workbench.episode

    def killed_after_rows(env, actor, seed, *args, **more):
        played.append(seed)
        if len(played) == rows + 1:
            raise KeyboardInterrupt
        return original(env, actor, seed, *args, **more)

    monkeypatch.setattr(workbench, "episode", killed_after_rows)
    with pytest.raises(KeyboardInterrupt):
        roll(run, **options)
    return played


def test_rows_of_another_renderer_are_not_mixed_in(run, monkeypatch, caplog):
    played = left_over(run, monkeypatch)
    monkeypatch.setattr(FakeEnvironment, "renderer", lambda self: "llvmpipe")
    (summary,) = roll(run)
    assert played[3:] == list(range(100_000, 100_006))
    assert summary["fingerprint"]["gl_renderer"] == "llvmpipe"
    assert "is damaged or of another gl_renderer: starting over" in caplog.text


def test_rows_of_other_code_are_not_mixed_in(run, monkeypatch):
    played = left_over(run, monkeypatch)
    code = {"version": "0", "commit": "a" * 40, "dirty": True, "changes": "12"}
    monkeypatch.setattr("imfvla.rollouts.rollout_log.code_version", lambda: code)
    roll(run)
    assert played[3:] == list(range(100_000, 100_006))


def test_a_finished_evaluation_without_its_rows_is_refused(run):
    (summary,) = roll(run)
    episodes = run.rollouts(NAME) / "episodes.jsonl"
    episodes.unlink()
    with pytest.raises(UserError, match=r"episodes\.jsonl is missing .*evaluate again with overwrite=true"):
        roll(run)
    (again,) = roll(run, overwrite=True)
    assert again["avg_return"] == summary["avg_return"]
    episodes.write_text(episodes.read_text().replace('"success": true', '"success": false'))
    with pytest.raises(UserError, match=r"episodes\.jsonl was changed after its summary\.json was written"):
        roll(run)


def test_numbers_come_from_the_rows(run, caplog):
    (summary,) = roll(run)
    path = run.rollouts(NAME) / "summary.json"
    path.write_text(json.dumps(summary | {"avg_return": 1234.5, "success_of_goal": {"a": [1, 1]}}))
    (found,) = roll(run)
    assert found == summary
    assert "summary.json was changed: its avg_return is not that of the episodes" in caplog.text


@pytest.mark.parametrize("first_seed", [100_000, 200_000])
def test_a_changed_config_gives_no_old_summary_and_no_rows_beside_old_ones(run, first_seed):
    roll(run)
    config = yaml.safe_load((run.path / "config.yaml").read_text())
    (run.path / "config.yaml").write_text(yaml.safe_dump(config | {"horizon": {"exec": 4}}))
    with pytest.raises(
        UserError, match=rf"config\.yaml is not what .*{NAME}/summary\.json was evaluated with"
    ):
        roll(run, first_seed=first_seed)
    assert [path.name for path in run.path.glob("rollouts/*")] == [NAME]


def test_the_keys_that_differ_from_the_training_are_named(run):
    config = yaml.safe_load((run.path / "config.yaml").read_text())
    trained = {"config": config | {"horizon": {"exec": 16}}}
    (run.weights_directory(20) / "policy.json").write_text(json.dumps(trained))
    (run.path / "config.yaml").write_text(yaml.safe_dump(config | {"horizon": {"exec": 4}}))
    with pytest.raises(UserError, match=r"horizon\.exec was 16, is 4\. Restore config\.yaml"):
        roll(run)
    assert not list(run.path.glob("rollouts/*"))


def running(run: RunDirectory, **options) -> list[dict]:
    """An evaluation on a running clock."""
    return roll(run, clock="running", **options)


def test_a_delay_is_part_of_protocol_name_and_row(run):
    roll(run)
    paused = untimed_lines(run.rollouts(NAME))
    (summary,) = running(run, delay_ms=50, meanwhile="continue")
    assert summary["name"] == f"{NAME}_delay50-continue"
    protocol = summary["protocol"]
    assert (protocol["clock"], protocol["delay_ms"], protocol["delay_steps"]) == ("running", 50, 3)
    lines = untimed_lines(run.rollouts(summary["name"]))
    assert running(run, delay_ms=50, meanwhile="continue", overwrite=True)[0]["protocol"] == protocol
    assert untimed_lines(run.rollouts(summary["name"])) == lines
    (none,) = running(run, delay_ms=0)
    without = [
        re.sub(r'"chunk_jump": [^,]*, ', "", line) for line in untimed_lines(run.rollouts(none["name"]))
    ]
    assert without == paused == untimed_lines(run.rollouts(NAME))
    text = table_of([found for found in evaluations(run) if not found.is_usual]).notes[0]
    assert "NFE 1: delay 50 ms (3 steps), continue." in text
    assert [found.folder.name for found in rows(run)] == [NAME]  # the usual one stands for the run


def test_an_evaluation_from_before_the_clock_is_not_repeated(run):
    (summary,) = roll(run)
    path = run.rollouts(NAME) / "summary.json"
    old = {key: summary["protocol"][key] for key in summary["protocol"] if key not in USUAL}
    del summary["description_digest"]
    path.write_text(json.dumps(summary | {"protocol": old}))
    assert roll(run) == [summary]


def test_a_measured_delay_is_taken_once_and_alone(run, monkeypatch):
    (summary,) = running(run, delay_ms="measured")
    alone = summary["latency_alone"]
    assert summary["name"] == f"{NAME}_delaymeasured-hold"
    assert alone["median_ms"] > 0 <= alone["load"]
    assert (alone["calls"], alone["nfe"], alone["device"]) == (200, 1, "cpu")
    assert summary["inference_ms_mean"] > 0  # of the rollouts
    monkeypatch.setattr(workbench, "measure_latency", lambda *_: pytest.fail("measured again"))
    (kept,) = running(run, delay_ms="measured", meanwhile="continue", episodes=2)
    assert kept["latency_alone"] == alone
    late = {"median_ms": 30.0, "p95_ms": 31.0, "calls": 20, "at": "2026-11-28", "load": 0.5}
    monkeypatch.setattr(workbench, "measure_latency", lambda *_: late)
    (again,) = running(run, delay_ms="measured", overwrite=True)
    assert again["protocol"]["delay_steps"] == 2
    assert (
        "takes 30.0 ms (p95 31.0) alone"
        in table_of([found for found in evaluations(run) if found.folder.name == again["name"]]).notes[0]
    )


def test_a_full_latency_file_keeps_the_newest(run, monkeypatch):
    monkeypatch.setattr("imfvla.rollouts.latency.MOST_LATENCIES", 2)
    protocol = Protocol("fake", "default", 3, "0" * 16, 1, 0, 1.0, 0, 1, None, "cpu")
    taken = {"median_ms": 30.0, "p95_ms": 31.0, "calls": 20, "at": "2026-11-28", "load": 0.5}
    for nfe in (1, 2, 3):
        latency_of(run, replace(protocol, nfe=nfe), lambda: taken)
    assert [kept["nfe"] for kept in json.loads((run.path / "latency.json").read_text())] == [2, 3]


def test_a_damaged_latency_is_named(run):
    (run.path / "latency.json").write_text('[{"median_ms": "fast"}]')
    with pytest.raises(UserError, match=r"latency\.json.*median_ms must be a finite number"):
        running(run, delay_ms="measured")


def test_a_delay_that_is_too_long_is_refused_before_anything_runs(run):
    with pytest.raises(
        UserError, match=r"delay_ms=100 is 5 control steps at 50 Hz, .* at most 4 are possible"
    ):
        running(run, delay_ms=100, meanwhile="continue")
    assert not (run.path / "rollouts").exists()


def test_a_condition_is_part_of_protocol_name_and_row_and_leaves_the_starts(run):
    (plain,) = roll(run)
    before = untimed_lines(run.rollouts(NAME))
    (summary,) = roll(run, condition=ConditionOptions("action_lag", 2))
    assert summary["name"] == f"{NAME}_action_lag2"
    assert (summary["protocol"]["condition"], summary["protocol"]["severity"]) == ("action_lag", 2)
    found = {evaluation.folder.name: evaluation for evaluation in evaluations(run)}
    assert found[summary["name"]].unusual == ("action_lag 2",)
    digests = [[row["start_digest"] for row in found[name].episodes] for name in (NAME, summary["name"])]
    assert digests[0] == digests[1]
    assert roll(run, overwrite=True)[0]["protocol"] == plain["protocol"]
    assert untimed_lines(run.rollouts(NAME)) == before


@pytest.mark.parametrize("workers", [0, 1])
def test_a_condition_that_the_environment_cannot_have_is_refused_before_anything_runs(run, workers):
    with pytest.raises(UserError, match=r"condition=mass needs a MuJoCo simulation .* the environment fake"):
        roll(run, condition=ConditionOptions("mass", 1), workers=workers)
    assert not list(run.path.glob("rollouts/*"))
