"""The grammar of run directories: what names one, and that every reader takes from the name what the writer put in."""

import re
import subprocess
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from imfvla.storage.run_names import MAX_KEY, run_key, run_name

ROOT = Path(__file__).resolve().parents[2]
WORDS = st.text(st.sampled_from("abz09_./@:{}~+-=,[] '"), max_size=12)
LONG = st.integers(0, 150).map(lambda length: f"core.text={'x' * length}")
OVERRIDES = st.lists(st.one_of(st.builds("{}={}".format, WORDS, WORDS), WORDS, LONG), max_size=5)


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ([], "default"),
        (["+exp=socket_ph32_exec16", "name=x"], "default"),
        (["evaluation.nfe=[1]", "training.threads=1", "demos.workers=1"], "default"),
        (["seed=1", "horizon.pred=8"], "horizon.pred=8,seed=1"),
        (["horizon.pred=8", "seed=1"], "horizon.pred=8,seed=1"),
        (["observation.views=[front, top]"], "observation.views=front,top"),
        (["+generator/times=beta"], "generator-times=beta"),
        (["demos.episodes=../../x"], "demos.episodes=..-..-x"),
        (["encoder=a/b:c"], "encoder=a-b-c"),
    ],
)
def test_run_names(overrides, name):
    assert run_name(overrides) == name


def test_long_options_of_a_source_are_a_digest_behind_its_name():
    """So that the rest of the name can be read, and every other option is another run."""
    options = ["demos.path=data/bags", "demos.control_hz=20", "demos.instruction=pick up the red block"]
    name = run_name(["task=none", "demos=ros2", *options, "seed=1", "training.steps=9"])
    assert re.fullmatch(r"demos=ros2-[0-9a-f]{8},seed=1,task=none,training\.steps=9", name)
    assert run_name(["task=none", "demos=ros2", *reversed(options), "seed=1", "training.steps=9"]) == name
    changed = run_name(["task=none", "demos=ros2", *options[:2], "demos.instruction=pick up the red cube"])
    assert changed.startswith("demos=ros2-")
    assert changed.split(",")[0] not in name
    assert re.fullmatch(r"demos=[0-9a-f]{8}", run_name(options))  # chosen by an experiment
    assert run_name(["demos=lerobot", "demos.path=data/aloha"]) == "demos.path=data-aloha,demos=lerobot"


def test_long_run_names_are_cut_and_stay_apart():
    names = {run_name([f"core.something_long={'x' * 200}{number}"]) for number in range(3)}
    assert len(names) == 3
    assert all(len(name) == MAX_KEY for name in names)


@pytest.mark.parametrize("seed", ["seed=3", "++seed=0"])
@settings(max_examples=300, deadline=None, derandomize=True)
@example(overrides=["+core/conditioning=adaln", "observation.views=[front,top]"])
@example(overrides=["core.text=" + "x" * 130, "training.steps=5", "horizon.pred=8"])
@given(overrides=OVERRIDES)
def test_a_row_is_answered_by_every_seed_of_the_runs_that_its_overrides_name(overrides, seed):
    key = run_key(run_name(overrides))
    assert run_key(run_name([*overrides, seed])) == key
    assert run_key(run_name([seed, *reversed(overrides), "evaluation.nfe=[1,2]"])) == key
    assert run_key(key) == key or key == "default"


def test_the_training_seed_is_no_part_of_what_a_name_says():
    assert run_key("default") == run_key("seed=2") == ""
    assert run_key("core=standard,seed=2") == "core=standard"
    assert run_key("core/conditioning=adaln") == "core-conditioning=adaln"


def test_committed_results_keep_their_names():
    """Every directory of experiments/results is the name of its own overrides."""
    listed = subprocess.run(
        ["git", "ls-files", "experiments/results"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.splitlines()
    names = {Path(line).parts[3] for line in listed}
    if not names:
        pytest.skip("not a checkout")
    assert {run_name(name.split(",")) for name in names} == names
