"""What experiments/protocol.md says about tests is what the code does."""

import re
from pathlib import Path

import pytest
from synthetic_runs import make_run, write_evaluation

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.comparisons import CONTRASTS
from imfvla.reporting.episodes import read_episodes
from imfvla.reporting.runs import evaluations
from imfvla.reporting.statistics import contrasts, significance
from imfvla.reporting.statistics.pairs import Pairs
from imfvla.reporting.statistics.power import ALPHA
from imfvla.storage.run_directory import RunDirectory

PAGE = (Path(__file__).resolve().parents[2] / "experiments" / "protocol.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
COMPARED = SECTIONS["What is compared"]
NAMES = {contrasts.MCNEMAR, contrasts.SIGN_FLIP, contrasts.SEEDS}
OF = {  # what the page calls a metric of a comparison
    "avg_return": "returns",
    "success_episodes": "successes",
    "inference_ms_mean": "times of a chunk",
    "inference_fps": "times of a chunk",
}


def named_tests() -> dict[str, tuple[str, str]]:
    """What is compared -> the test with one training seed, and that with several."""
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", COMPARED, re.MULTILINE)
    return {what: tests for what, *tests in rows[1:]}


@pytest.fixture(scope="module", params=[1, 2], ids=["one training seed", "two training seeds"])
def pairs(request, tmp_path_factory) -> tuple[int, Pairs]:
    directory, policies = tmp_path_factory.mktemp("runs"), []
    for stream, name in enumerate(("ours", "theirs")):
        policy = []
        for seed in range(request.param):
            run = directory / name / f"seed={seed}"
            folder = write_evaluation(
                make_run(run, name, seed=seed),
                1,
                number=20,
                stream=2 * stream + seed,
                weights=f"{name}{seed}",
            )
            (found,) = evaluations(RunDirectory(run))
            policy.append(Evaluated(found, read_episodes(folder / "episodes.jsonl", found.seeds)))
        policies.append(policy)
    return request.param, Pairs(*policies)


def test_the_page_has_a_row_for_everything_that_is_compared():
    assert set(named_tests()) == set(OF.values())
    assert {of for of, _ in CONTRASTS} == set(OF)
    assert {name for tests in named_tests().values() for name in tests} == NAMES


@pytest.mark.parametrize(("of", "operation"), CONTRASTS, ids=" ".join)
def test_the_code_uses_the_test_that_the_page_names(of, operation, pairs):
    seeds, policies = pairs
    contrast, _ = CONTRASTS[of, operation]
    assert contrast(policies).test == named_tests()[OF[of]][min(seeds, 2) - 1]


def test_the_page_names_the_code_s_numbers():
    words = " ".join(COMPARED.split())
    assert f"exact up to {significance.MOST_EXACT} pairs that differ" in words
    assert f"else from {significance.FLIPS:,} draws" in words
    assert f"corrected p is below {ALPHA}" in words
    assert "after Holm's correction" in words


def test_no_other_test_is_named_where_the_rules_are():
    rules = "".join(text for title, text in SECTIONS.items() if title != "Changed later")
    assert not re.findall(r"Wilcoxon|signed.rank|Mann|Welch|rank.sum|Bonferroni|Fisher", rules)
    assert "Wilcoxon signed-rank" in SECTIONS["Changed later"]
