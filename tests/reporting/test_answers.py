"""Which runs answer which rows, which are refused, and what is proposed where none is there."""

import json
from pathlib import Path

import pytest
import yaml
from synthetic_runs import STEPS, answer_row, make_run, write_evaluation

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.reporting.answers import Sources, check_equal_protocols, read_evaluated
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.metrics import summarise
from imfvla.reporting.recomputed import digest_of
from imfvla.reporting.runs import rows
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.trained_config import digest_of_config

MAPPING = read_mapping()
ROWS = {row.name: row for row in MAPPING.rows}


def answer(name: str, *directories: Path):
    return Sources(directories).answer(ROWS[name], MAPPING)


def test_a_row_is_answered_by_its_policy_weights_and_evaluations(tmp_path):
    folder = answer_row(tmp_path, ROWS["socket_infer1"])
    assert folder.name.endswith(f"nfe1_step{STEPS // 3}")
    (found,) = answer("socket_infer1", tmp_path).evaluated
    assert found.evaluation.folder == folder
    assert [row["seed"] for row in found.episodes] == list(range(100_000, 100_100))
    for other in ("socket_infer2", "socket_flow_infer1", "transfer_infer1"):
        assert answer(other, tmp_path).is_missing


@pytest.mark.parametrize(
    "name", ["socket_infer1", "socket_infer2", "socket_ddim_infer10", "socket_l1", "transfer_flow_infer2"]
)
def test_no_other_row_is_answered_by_the_same_run(tmp_path, name):
    answer_row(tmp_path, ROWS[name])
    sources = Sources([tmp_path])
    assert [row.name for row in MAPPING.rows if not sources.answer(row, MAPPING).is_missing] == [name]


def test_runs_with_other_overrides_and_seeds_of_selection_answer_nothing(tmp_path):
    name = "socket_ph32_exec16"
    write_evaluation(make_run(tmp_path / name / "core=standard", name), 2, number=100)
    write_evaluation(make_run(tmp_path / name / "default", name), 2, first_seed=10_000)
    write_evaluation(make_run(tmp_path / name / "default", name), 2, number=100, max_steps=50)
    assert answer("socket_imf_infer2", tmp_path).is_missing


def test_a_run_stands_for_itself_with_the_usual_noise_and_each_noise_is_listed(tmp_path):
    name = "socket_ph32_exec16"
    run = make_run(tmp_path / name / "default", name)
    for noise in ({}, {"noise_scale": 0.5}, {"noise_scale": 0.0}):
        write_evaluation(run, 2, number=100, **noise)
    assert [found.noise_scale for found in rows(RunDirectory(run))] == [1.0]
    in_row = answer("socket_imf_infer2", tmp_path)
    assert [found.evaluation.noise_scale for found in in_row.evaluated] == [1.0]
    others = Sources([tmp_path]).others([in_row])
    assert [found.evaluation.label for [found] in others] == [f"{name}, noise 0", f"{name}, noise 0.5"]


def test_a_later_directory_counts_alone(tmp_path):
    for directory, quality in (("shipped", 0.9), ("runs", 0.3)):
        answer_row(tmp_path / directory, ROWS["socket_infer2"], quality=quality)
    for order in (("shipped", "runs"), ("runs", "shipped")):
        (found,) = answer("socket_infer2", *(tmp_path / name for name in order)).evaluated
        assert found.evaluation.folder.is_relative_to(tmp_path / order[-1])


def test_training_seeds_answer_together(tmp_path):
    for seed in (2, 0, 1):
        answer_row(tmp_path, ROWS["socket_l1"], seed=seed)
    found = answer("socket_l1", tmp_path).evaluated
    assert [one.evaluation.training_seed for one in found] == [0, 1, 2]
    assert [one.evaluation.run.name for one in found][1:] == ["generator=l1,seed=1", "generator=l1,seed=2"]


def test_two_runs_of_one_seed_are_refused(tmp_path):
    answer_row(tmp_path / "a", ROWS["socket_infer2"])
    answer_row(tmp_path / "b", ROWS["socket_infer2"])
    with pytest.raises(
        UserError, match=r"line \d+, table1, row 4 \(socket_infer2\) is answered twice, by .*/a/.* and"
    ):
        answer("socket_infer2", tmp_path)


def test_training_seeds_of_different_configs_are_refused(tmp_path):
    answer_row(tmp_path, ROWS["socket_infer2"])
    folder = answer_row(tmp_path, ROWS["socket_infer2"], seed=1)
    path = folder.parents[1] / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"horizon": {"exec": 8}}))
    with pytest.raises(UserError, match=r"runs of different configs.*horizon\.exec was 16, is 8"):
        answer("socket_infer2", tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"number": 50}, "episodes is 50, not 100"),
        ({"first_seed": 200_000}, "first_seed is 200000, not 100000"),
        ({"noise_seed": 3}, "noise_seed is 3, not 0"),
        ({"device": "cuda"}, "device is 'cuda', not 'cpu'"),
    ],
)
def test_an_evaluation_of_another_protocol_is_refused_with_the_command_for_the_right_one(
    tmp_path, change, message
):
    answer_row(tmp_path, ROWS["socket_infer2"], **change)
    with pytest.raises(
        UserError, match=rf"row 4 \(socket_infer2\) needs another.*{message}\. Run: python -m imfvla\."
    ):
        answer("socket_infer2", tmp_path)
    (tmp_path / "good").mkdir()
    folder = answer_row(tmp_path / "good", ROWS["socket_infer2"])
    (found,) = answer("socket_infer2", tmp_path).evaluated
    assert found.evaluation.folder == folder


def test_tables_do_not_mix_protocols(tmp_path):
    answer_row(tmp_path, ROWS["socket_infer2"])
    answer_row(tmp_path, ROWS["socket_act"], variant="hard")
    sources = Sources([tmp_path])
    answers = [sources.answer(row, MAPPING) for row in MAPPING.of_table("table1")]
    with pytest.raises(
        UserError, match=r"table1 mixes protocols: variant is 'default' in .* row 4\) and 'hard'"
    ):
        check_equal_protocols(answers, "socket")


def test_damaged_episodes_and_changed_summaries_are_named(tmp_path):
    folder = answer_row(tmp_path, ROWS["socket_infer2"])
    summary = folder / "summary.json"
    text = summary.read_text()
    summary.write_text(json.dumps(json.loads(text) | {"success_episodes": 100}))
    with pytest.raises(
        UserError,
        match=r"episodes\.jsonl gives another success_episodes than its summary\.json: one was changed",
    ):
        answer("socket_infer2", tmp_path)
    digest = {"episodes_digest": digest_of((folder / "episodes.jsonl").read_text(encoding="utf-8"))}
    summary.write_text(json.dumps(json.loads(text) | digest | {"avg_return": 1234.5}))
    (found,) = answer("socket_infer2", tmp_path).evaluated
    assert found.evaluation.summary["avg_return"] == json.loads(text)["avg_return"]
    summary.write_text(json.dumps(json.loads(text) | {"episodes_digest": "0" * 16}))
    with pytest.raises(UserError, match=r"episodes\.jsonl was changed after its summary\.json was written"):
        answer("socket_infer2", tmp_path)
    summary.write_text(text)
    episodes = folder / "episodes.jsonl"
    episodes.write_text(episodes.read_text()[:-30])
    with pytest.raises(UserError, match=r"episodes\.jsonl, line 100 is cut off"):
        answer("socket_infer2", tmp_path)


def test_a_metric_that_the_summary_does_not_have_yet_is_left_out(tmp_path, monkeypatch):
    write_evaluation(make_run(tmp_path / "a", "socket_ph32_exec16"), 2)
    monkeypatch.setattr(
        "imfvla.reporting.recomputed.summarise", lambda rows: summarise(rows) | {"new_metric": 1}
    )
    assert [len(found.episodes) for found in read_all(tmp_path)] == [20]


def read_all(directory: Path):
    return [read_evaluated(found) for found in Sources([directory]).evaluations[0]]


@pytest.mark.parametrize(
    ("key", "value"), [("nfe", 3), ("checkpoint_step", 7), ("seeds", [100_001, 100_100])]
)
def test_a_description_that_contradicts_its_protocol_is_refused(tmp_path, key, value):
    path = answer_row(tmp_path, ROWS["socket_infer2"]) / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(UserError, match=r"summary\.json states .*, but its protocol has .*one was changed"):
        Sources([tmp_path])


def test_a_copied_run_is_no_second_training_seed(tmp_path):
    """Its config.yaml says seed 1, and its weights are those of seed 0."""
    for seed in (0, 1):
        answer_row(tmp_path, ROWS["socket_l1"], seed=seed, weights="ab" * 8)
    with pytest.raises(
        UserError, match=r"have the same weights \((ab)+\), so that seeds 0 and 1 are one training"
    ):
        answer("socket_l1", tmp_path)


def test_a_copied_run_outside_of_the_tables_is_none_either(tmp_path):
    for seed in (0, 1):
        run = make_run(tmp_path / "a" / f"seed={seed}", "a", seed=seed)
        write_evaluation(run, 2, weights="ab" * 8)
    with pytest.raises(UserError, match="have the same weights"):
        Sources([tmp_path]).others([])


def test_a_config_that_changed_since_an_evaluation_is_refused(tmp_path):
    folder = answer_row(tmp_path, ROWS["socket_infer2"])
    run, path = folder.parents[1], folder / "summary.json"
    config = yaml.safe_load((run / "config.yaml").read_text())
    digest = {"config_digest": digest_of_config(config)}
    path.write_text(json.dumps(json.loads(path.read_text()) | digest))
    assert len(Sources([tmp_path]).evaluations[0]) == 1
    (run / "config.yaml").write_text(yaml.safe_dump(config | {"horizon": {"exec": 4}}))
    with pytest.raises(UserError, match=r"config\.yaml is not what .*summary\.json was evaluated with"):
        Sources([tmp_path])


def test_a_missing_run_is_proposed_with_all_evaluations_of_its_rows(tmp_path):
    assert answer("socket_ddim_infer2", tmp_path).command == (
        "python -m imfvla.train +exp=socket_ddpm_ph32_exec16 'evaluation.nfe=[1,2,10,100]'"
    )
    assert answer("socket_l1", tmp_path).command == (
        "python -m imfvla.train +exp=socket_ph32_exec16 generator=l1 'evaluation.nfe=[1]'"
    )
    train, evaluate = answer("socket_infer1", tmp_path).command.split(" && ")
    assert (
        train == "python -m imfvla.train +exp=socket_ph32_exec16 generator=imf_plain 'evaluation.nfe=[2,3]'"
    )
    assert evaluate == (
        "python -m imfvla.evaluate run=runs/socket_ph32_exec16/generator=imf_plain nfe=1 checkpoint=1/3 "
        "first_seed=100000 episodes=100"
    )


def test_where_the_weights_are_there_an_evaluation_is_proposed(tmp_path):
    run = make_run(tmp_path / "socket_ph32_exec16" / "generator=imf_plain", "socket_ph32_exec16")
    (run / "checkpoints" / f"step-{STEPS}").mkdir(parents=True)
    assert answer("socket_infer2", tmp_path).command == (
        f"python -m imfvla.evaluate run={run} nfe=2 first_seed=100000 episodes=100"
    )
    assert answer("socket_infer1", tmp_path).command.startswith("python -m imfvla.train")
    (run / "checkpoints" / f"step-{STEPS // 3}").mkdir()
    assert answer("socket_infer1", tmp_path).command.startswith(f"python -m imfvla.evaluate run={run} nfe=1")


def test_training_evaluates_as_the_rows_want():
    evaluation = compose("train")["evaluation"]
    for row in MAPPING.rows:
        for name in row.wanted.__slots__:
            assert getattr(row.wanted, name) == evaluation[name]


def test_what_stands_in_no_row_is_listed(tmp_path):
    folder = answer_row(tmp_path, ROWS["socket_imf_infer2"])
    name = "socket_ph32_exec16"
    last = write_evaluation(folder.parents[1], 10, number=100)
    another = write_evaluation(make_run(tmp_path / name / "seed=1", name, seed=1), 10, number=100)
    standard = write_evaluation(make_run(tmp_path / name / "core=standard", name), 2, number=100)
    sources = Sources([tmp_path])
    others = sources.others([sources.answer(row, MAPPING) for row in MAPPING.rows])
    assert [[found.evaluation.folder for found in seeds] for seeds in others] == [[last, another], [standard]]
