"""Which evaluations are pairs, and with which reason others are not."""

import re
from pathlib import Path

import numpy as np
import pytest
from synthetic_runs import MACHINE, make_run, write_evaluation

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.episodes import read_episodes
from imfvla.reporting.runs import evaluations
from imfvla.reporting.statistics.pairs import Pairs, refusal
from imfvla.storage.run_directory import RunDirectory


def evaluated(path: Path, **options) -> Evaluated:
    """An evaluation of six episodes."""
    folder = write_evaluation(make_run(path, path.name), 1, **({"number": 6} | options))
    (found,) = (found for found in evaluations(RunDirectory(path)) if found.folder == folder)
    return Evaluated(found, read_episodes(folder / "episodes.jsonl", found.seeds))


@pytest.fixture
def ours(tmp_path) -> Evaluated:
    return evaluated(tmp_path / "ours")


def test_equal_starts_are_pairs(ours, tmp_path):
    theirs = [evaluated(tmp_path / name, stream=stream) for stream, name in enumerate(("a", "b"))]
    assert refusal([ours], theirs, times=True) is None
    successes = Pairs([ours], theirs).columns(lambda row: row["seed"])
    assert [column.shape for column in successes] == [(1, 6), (2, 6)]
    np.testing.assert_array_equal(successes[0][0], successes[1][1])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"number": 5}, "has 6 episodes and .*theirs.* 5"),
        ({"first_seed": 100_001}, "seed 100000 of .* starts from .* and seed 100001 of .*theirs.* from"),
        ({"noise_seed": 3}, "noise_seed is 0 of .* and 3 of .*theirs"),
        ({"task": "transfer"}, "task is 'socket' of .* and 'transfer' of"),
        ({"max_steps": 50}, "max_steps is None of .* and 50 of"),
    ],
)
def test_other_starts_are_refused_with_the_reason(ours, tmp_path, options, reason):
    theirs = evaluated(tmp_path / "theirs", **options)
    assert re.search(reason, refusal([ours], [theirs]))


def test_every_training_seed_must_have_met_the_same_starts(ours, tmp_path):
    other = evaluated(tmp_path / "other", number=4)
    assert "has 6 episodes" in refusal([ours], [ours, other])
    assert "has 6 episodes" in refusal([ours, other], [ours])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            {"machine": MACHINE | {"cpu": "a slow CPU"}},
            "different machines: cpu 'a fast CPU' and 'a slow CPU'",
        ),
        ({"device": "cuda"}, "different machines: device 'cpu' and 'cuda'"),
    ],
)
def test_another_machine_is_refused_for_times_alone(ours, tmp_path, options, reason):
    theirs = evaluated(tmp_path / "theirs", **options)
    assert refusal([ours], [theirs]) is None
    assert reason in refusal([ours], [theirs], times=True)


def test_evaluations_of_the_same_weights_are_of_one_policy(ours, tmp_path):
    same, other = evaluated(tmp_path / "same"), evaluated(tmp_path / "other", weights="f" * 16)
    one, another = (np.zeros(6),), (np.ones(6),)
    assert len(Pairs([ours], [same]).policies(one, another)) == 1
    assert len(Pairs([ours], [other]).policies(one, another)) == 2
