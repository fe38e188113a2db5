"""Rows to runs: the file of the repository, and every way in which such a file may be wrong."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from imfvla.errors import UserError
from imfvla.reporting.mapping import PATH, read_mapping
from imfvla.storage.run_names import run_key, run_name

TEXT = PATH.read_text()


def test_rows_are_answered_by_the_directories_that_training_makes():
    for row in read_mapping().rows:
        assert row.run == run_key(run_name(row.overrides))
        assert row.run == run_key(run_name([*row.overrides, "seed=3", "evaluation.nfe=[1]"]))


@pytest.mark.parametrize(
    "overrides",
    [("observation.views=[front,top]",), ("+core/conditioning=adaln",), (f"core.text={'x' * 130}",)],
)
def test_a_row_of_lists_groups_and_long_values_is_answered_too(overrides):
    row = replace(read_mapping().rows[0], overrides=overrides)
    assert row.run == run_key(run_name([*overrides, "seed=3"]))


def test_three_rivals_in_each_table_beside_the_paper_s_rows():
    for table, printed in (("table1", 7), ("table2", 11)):
        rows = read_mapping().of_table(table)
        assert sum(row.paper is not None for row in rows) == printed
        rivals = [row for row in rows if row.paper is None]
        assert sorted(row.nfe for row in rivals if "Flow" in row.method) == [1, 2, 10]
        assert sorted({row.nfe for row in rivals if "DDIM" in row.method}) == [1, 2, 10]
        assert [row.run for row in rivals if "L1" in row.method] == ["generator=l1"]


def test_evaluations_that_the_paper_prints_are_those_of_the_rows():
    for row in read_mapping().rows:
        printed = re.search(r"infer(\d+)", row.setting)
        assert printed is None or int(printed.group(1)) == row.nfe


def test_a_checkpoint_is_a_share_of_the_training():
    first, second = read_mapping().rows[:2]
    assert (first.step(6000), second.step(6000)) == (2000, 6000)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("nfe: 2 }", "nfee: 2 }", r"line \d+, table1, row \d+\.nfee \(did you mean nfe\?\)"),
        ("nfe: 2 }", "nfe: 0 }", r"line \d+, table1, row 4: nfe must be at least 1, found 0"),
        ("nfe: 2 }", "nfe: two }", r"line \d+, table1, row 4\.nfe must be a whole number, found 'two'"),
        ("checkpoint: 1/3", "checkpoint: 4/3", r"line \d+, table1, row 1: checkpoint must be last or a share"),
        ("ACT (action chunking)", "ACT (chunks)", r"row 6: unknown row of the paper's Table 1 'ACT \(chunks\)'"),
        ("row: socket_infer3", "row: socket_infer4", r"table3, row 1: unknown row 'socket_infer4' \(did you mean"),
        ("name: socket_act", "name: socket_infer1", r"row 6: the name socket_infer1 is taken by .*row 1"),
        ("as: ratio }", "as: quotient }", r"table3, row 1: as must be ratio or"),
        ("of: avg_return", "of: reward", r"table3, row 1: of must be avg_return or"),
        ("paper: \"ACT (action chunking)\"", "method: ACT", r"row 6 must have paper, or method and setting"),
        ("paper: \"ACT (action chunking)\"", "method: ACT, setting: chunks", r"paper's row 'ACT .*' once, found 0"),
        ("evaluation: {", "evaluations: {", r"Unknown key evaluations \(did you mean evaluation\?\)"),
        ("\ntable1:", "\ntable1: []\ntable1:", r"line \d+ has table1 twice"),
        ("\ntable1:", "\ntable1: [", "cannot be read as YAML"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, old, new, message):
    path = tmp_path / "tables.yaml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as caught:
        read_mapping(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_row_may_want_another_evaluation(tmp_path: Path):
    path = tmp_path / "tables.yaml"
    path.write_text(TEXT.replace("nfe: 2 }", "nfe: 2, evaluation: { episodes: 50 } }", 1))
    row = read_mapping(path).rows[3]
    assert (row.wanted.episodes, row.wanted.first_seed) == (50, 100_000)


def with_baselines(path: Path, baselines: str) -> Path:
    """A copy of the tables in which all comparisons on `transfer_dwell` are of one row with these."""
    head, title, rest = TEXT.partition("\ndwell_compared:\n")
    entry = f"  - {{ row: dwell_imf_infer1, baseline: {baselines}, of: success_episodes, as: difference }}"
    path.write_text(head + title + entry + rest[rest.index("\n\n") :])
    return path


def test_a_list_of_baselines_is_as_many_comparisons(tmp_path: Path):
    mapping = read_mapping(with_baselines(tmp_path / "two.yaml", "[dwell_imle, dwell_l1]"))
    found = [(c.row.name, c.baseline.name) for c in mapping.of_comparisons("dwell_compared")]
    assert found == [("dwell_imf_infer1", "dwell_imle"), ("dwell_imf_infer1", "dwell_l1")]


@pytest.mark.parametrize("baselines", ["[]", "[dwell_l1, dwell_l1]", "{}"])
def test_baselines_are_a_name_or_different_names(tmp_path: Path, baselines):
    with pytest.raises(UserError, match=r"dwell_compared, row 1\.baseline must be"):
        read_mapping(with_baselines(tmp_path / "tables.yaml", baselines))
