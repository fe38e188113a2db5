"""A finished run becomes a small directory that says what made it."""

import json
from pathlib import Path

import pytest
import yaml

from imfvla.config.assets import folder
from imfvla.errors import UserError
from imfvla.reporting.metrics import summarise
from imfvla.reporting.model_card import model_card
from imfvla.reporting.shipping import command_of, ship
from imfvla.storage.files import write_json
from imfvla.storage.run_directory import DONE, RUNNING, RunDirectory

EPISODE = {
    "seed": 100_000,
    "start_digest": "0" * 16,
    "first_step_of_stage": [],
    "total_reward": 900.0,
    "num_steps": 700,
    "max_reward": 5.0,
    "success": True,
    "failure": None,
    "timing": {"wall_s": 2.0, "inference_ms": [4.0]},
}

POLICIES = folder("experiments") / "pretrained"
CONFIG = {
    "name": "socket_ph32_exec16", "seed": 3, "training": {"steps": 20, "batch_size": 32},
    "horizon": {"obs": 1, "pred": 32, "exec": 16},
    "task": {"name": "socket", "variant": "hard", "expert": {"modes": 2}},
    "demos": {"source": "scripted", "episodes": 50, "first_seed": 7},
    "generator": {"_target_": "imfvla.generators.flow.FlowMatching"}, "core": {"_target_": "imfvla.nn.act.ActCore"},
}  # fmt: skip
MADE = {
    "code": {"version": "0.1.0", "commit": "0123456789abcdef"}, "machine": {"cpu": "a fast | CPU"}, "threads": 2,
}  # fmt: skip


def make_run(path: Path, first_seed: int = 100_000, state: str = DONE, size: int = 10) -> RunDirectory:
    run = RunDirectory(path)
    write_json(run.path / "status.json", {"state": state})
    (run.path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    for step in (10, 20):
        weights = run.weights_directory(step) / "policy.safetensors"
        write_json(
            weights.with_suffix(".json"),
            {
                "step": step,
                "train_s": 60.0,
                "precision": "fp32",
                "num_parameters": 3_017_628,
                "fingerprint": MADE,
            },
        )
        weights.write_bytes(bytes(size))
    run.last_state.parent.mkdir()
    run.last_state.write_bytes(b"optimiser")
    run.metrics.write_text("".join(f'{{"step": {step}}}\n' for step in range(1, 31)))
    folder = run.rollouts("reported")
    folder.mkdir(parents=True)
    (folder / "episodes.jsonl").write_text(json.dumps(EPISODE | {"seed": first_seed}) + "\n")
    (folder / "median.mcap").write_bytes(b"large")
    write_json(
        folder / "summary.json",
        summarise([EPISODE])
        | {
            "name": "reported",
            "experiment": "socket_ph32_exec16",
            "nfe": 1,
            "checkpoint_step": 20,
            "seeds": [first_seed, first_seed],
            "protocol": {"task": "socket", "variant": "default", "max_steps": None},
            "fingerprint": {"machine": {"cpu": "a fast CPU"}},
        },
    )
    return run


def test_what_evaluation_needs_is_taken_and_the_rest_left(tmp_path):
    run = make_run(tmp_path / "runs" / "socket_ph32_exec16" / "training.steps=20")
    made_by = ship(run, tmp_path / "shipped")
    files = {str(path.relative_to(tmp_path / "shipped")) for path in (tmp_path / "shipped").rglob("*.*")}
    assert {path for path in files if "." in Path(path).name} == {
        "config.yaml",
        "status.json",
        "metrics.jsonl",
        "made_by.json",
        "README.md",
        "checkpoints/step-20/policy.safetensors",
        "checkpoints/step-20/policy.json",
        "rollouts/reported/episodes.jsonl",
        "rollouts/reported/summary.json",
    }
    assert (tmp_path / "shipped" / "metrics.jsonl").read_text().count("\n") == 3
    assert made_by["command"] == "python -m imfvla.train +exp=socket_ph32_exec16 training.steps=20"
    assert (made_by["code"], made_by["seed"]) == (MADE["code"], 3)
    assert made_by["results"]["reported"]["success_episodes"] == 1


def test_the_command_has_the_lists_that_the_directory_s_name_shows_without_brackets(tmp_path):
    run = make_run(tmp_path / "core=standard,encoder.vision.hidden=16,24,seed=3")
    config = {"name": "a", "seed": 3, "core": {"depth": 2}, "encoder": {"vision": {"hidden": [16, 24]}}}
    assert command_of(run, config) == (
        "python -m imfvla.train +exp=a core=standard 'encoder.vision.hidden=[16,24]' seed=3"
    )
    assert command_of(RunDirectory(tmp_path / "default"), config) == "python -m imfvla.train +exp=a"


def test_the_command_is_the_recorded_one_where_there_is_one(tmp_path):
    run = make_run(tmp_path / "core=standard")
    run.keep_overrides(["+exp=b", "core=standard", "training.threads=1"])
    run.keep_overrides(["+exp=b", "evaluation.nfe=[4]"])  # of a later command that only evaluates
    command = "python -m imfvla.train +exp=b core=standard training.threads=1"
    assert command_of(run, {"name": "a"}) == command
    write_json(run.path / "overrides.json", {"a": 1})
    with pytest.raises(UserError, match=r"overrides\.json.*must be a list, found .*; delete it"):
        command_of(run, {"name": "a"})


def test_results_alone_leave_the_weights_behind_however_large(tmp_path):
    run = make_run(tmp_path / "run", size=16_000_001)
    write_json(run.path / "depth_attention.json", {})
    ship(run, tmp_path / "results", with_weights=False)
    assert (tmp_path / "results" / "depth_attention.json").is_file()
    assert not list(tmp_path.glob("results/**/*.safetensors"))
    assert (tmp_path / "results" / "rollouts" / "reported" / "episodes.jsonl").is_file()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"state": RUNNING}, "not a finished run"),
        ({"first_seed": 10_000}, "no evaluation of the reporting band"),
        ({"first_seed": 1_000_000}, "no evaluation of the reporting band"),
        ({"size": 16_000_001}, "wanted at most 16000000"),
    ],
)
def test_what_may_not_be_shipped_is_refused_and_nothing_is_written(tmp_path, changes, reason):
    run = make_run(tmp_path / "run", **changes)
    with pytest.raises(UserError, match=reason):
        ship(run, tmp_path / "shipped")
    assert not (tmp_path / "shipped").exists()


def test_a_shipped_policy_is_not_overwritten(tmp_path):
    (tmp_path / "shipped").mkdir()
    with pytest.raises(UserError, match="exists already"):
        ship(make_run(tmp_path / "run"), tmp_path / "shipped")


def test_the_card_of_a_policy_says_what_it_is_and_reaches(tmp_path):
    run = make_run(tmp_path / "runs" / "socket_ph32_exec16" / "training.steps=20")
    ship(run, tmp_path / "mine" / "shipped")
    card = (tmp_path / "mine" / "shipped" / "README.md").read_text()
    assert card.startswith("# mine/shipped\n")
    for line in (
        "| policy | FlowMatching on ActCore, 3.02 M parameters |",
        "| task | socket (hard) |",
        "| demonstrations | scripted, episodes 50, first_seed 7, expert.modes 2 |",
        "| training | 20 steps of 32 observations, seed 3 |",
        "| its time | 1 min, 2 thread(s), fp32, a fast \\| CPU |",
        "| code | imfvla 0.1.0, commit 0123456 |",
        "| 1 | step 20 | 1/1 ",
        f"run={tmp_path}/mine/shipped nfe=1 ",
        "python -m imfvla.train +exp=socket_ph32_exec16 training.steps=20    # trained it, at the commit above",
    ):
        assert line in card
    assert "failed" not in card  # none did


@pytest.mark.parametrize("made", sorted(POLICIES.rglob("made_by.json")), ids=lambda path: path.parent.name)
def test_the_cards_of_the_shipped_policies_are_those_that_their_files_give(made):
    place = made.parent
    command = json.loads(made.read_text())["command"]
    assert (place / "README.md").read_text() == model_card(
        RunDirectory(place), place.relative_to(POLICIES.parents[1]), command
    ), "run python tools/model_cards.py"
