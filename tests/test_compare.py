"""Two runs against each other: what is said about them, the files that are written, and what is refused."""

from pathlib import Path

import pytest
from figures.seen import clipped, texts
from synthetic_runs import MACHINE, make_run, write_evaluation

from imfvla.compare import main
from imfvla.errors import UserError
from imfvla.figures.two_runs import counts, two_runs
from imfvla.reporting.two_runs import compare_runs, table_of, verdict
from imfvla.storage.run_directory import RunDirectory


@pytest.fixture
def runs(tmp_path) -> tuple[Path, Path]:
    """A is better than B from every start, and needs three quarters of its time."""
    paths = (make_run(tmp_path / "a" / "core=standard,seed=1", "a"), make_run(tmp_path / "b", "b"))
    for path, quality, latency in zip(paths, (0.8, 0.5), (3.0, 4.0), strict=True):
        for nfe in (1, 2):
            write_evaluation(path, nfe, quality=quality, number=40, latency_ms=latency * nfe)
    return paths


def compare(a: Path, b: Path, nfe=None):
    return compare_runs(RunDirectory(a), RunDirectory(b), nfe)


def test_a_better_run_is_named_and_a_worse_one_is_its_mirror(runs):
    there, back = compare(*runs), compare(*reversed(runs))
    assert [duel.label for duel in there] == ["infer1", "infer2"]
    text = verdict(there[0])
    assert text.startswith("infer1, 40 pairs. Success: A succeeds more often than B (+")
    assert "Speed: A is faster than B (1.33×" in text
    assert "Success: A succeeds less often than B (-" in verdict(back[0])
    for duel, mirror in zip(there, back, strict=True):
        assert counts(duel) == tuple(counts(mirror)[place] for place in (0, 2, 1, 3))
        for one, other in zip(duel.compared[:2], mirror.compared[:2], strict=True):
            assert one.contrast.result.value == pytest.approx(-other.contrast.result.value)
            assert one.p_holm == pytest.approx(other.p_holm)


def test_p_values_are_corrected_over_all_that_is_compared(runs):
    (alone,) = compare(*runs, nfe=[1])
    (together, _) = compare(*runs)
    assert sum(found.p_holm for found in together.compared) > sum(found.p_holm for found in alone.compared)


def test_no_difference_is_reported_with_what_would_have_been_found(tmp_path):
    for name, stream in (("a", 0), ("b", 9)):
        write_evaluation(make_run(tmp_path / name, name), 1, stream=stream)
    assert "Success: no difference shown (" in verdict(compare(tmp_path / "a", tmp_path / "b")[0])
    assert "would have been found with probability 0.8" in verdict(compare(tmp_path / "a", tmp_path / "b")[0])


def test_the_table_has_a_row_for_each_measure_and_the_picture_all_its_texts(runs):
    duels = compare(*runs)
    table = table_of(duels)
    assert [row[:2] for row in table.rows] == [
        (nfe, of) for nfe in ("infer1", "infer2") for of in ("Success", "Reward", "Speed")
    ]
    figure = two_runs(duels)
    assert not clipped(figure)
    assert {"infer1", "infer2", "both succeeded", "A alone succeeded", "speed, A over B"} <= set(
        texts(figure)
    )


def test_the_verdict_and_the_table_name_the_same_p_value_and_unit(runs):
    (duel,) = compare(*runs, nfe=[1])
    table = table_of([duel])
    success, _, speed = (dict(zip(table.columns, row, strict=True)) for row in table.rows)
    assert f"points, Holm-corrected p = {success['p (Holm)']})" in verdict(duel).replace("p < ", "p = <")
    assert {"p (uncorrected)", "p (Holm)"} < set(table.columns)
    assert speed["A"].endswith("] ms")
    assert speed["A against B"].startswith("1.33× [1.3")
    assert all(table.is_numeric(name) for name in ("A", "B", "A against B", "Detectable"))


def test_a_difference_of_nothing_is_drawn(tmp_path):
    """Two equal policies differ by 0 in reward, which is measured."""
    for name in ("a", "b"):
        write_evaluation(make_run(tmp_path / name, name), 1)
    figure = two_runs(compare(tmp_path / "a", tmp_path / "b"))
    assert "not compared" not in texts(figure)


def test_both_nfe_may_differ(runs):
    (duel,) = compare(*runs, nfe=[1, 2])
    assert duel.label == "infer1 against infer2"


def test_times_of_other_machines_are_refused_and_the_rest_compared(runs, tmp_path):
    other = make_run(tmp_path / "c", "c")
    write_evaluation(other, 1, quality=0.5, number=40, machine=MACHINE | {"cpu": "another"})
    (duel,) = compare(runs[0], other)
    assert "Success: A succeeds more often" in verdict(duel)
    assert "Speed: not compared, because" in verdict(duel)
    assert not clipped(two_runs([duel]))


@pytest.mark.parametrize(
    ("change", "nfe", "message"),
    [
        (
            {"noise_seed": 3},
            None,
            r"cannot be paired: noise_seed is 0 of .* and 3 of .*Evaluate both with the same protocol",
        ),
        ({"variant": "hard"}, None, r"cannot be paired: variant is"),
        ({}, [7], r"core=standard,seed=1 was evaluated with nfe 1, 2, not with 7"),
        ({}, [1, 7], r"c was evaluated with nfe 10, not with 7"),
        ({}, None, r"nfe 1, 2 and .*c with 10: no NFE is common to both; name one of each"),
    ],
)
def test_what_is_no_pair_is_refused(runs, tmp_path, change, nfe, message):
    other = make_run(tmp_path / "c", "c")
    write_evaluation(other, 1 if change else 10, number=40, **change)
    with pytest.raises(UserError, match=message):
        compare(runs[0], other, nfe)


def test_the_command_writes_its_files_and_prints_the_verdict(runs, tmp_path, capsys):
    output = tmp_path / "out"
    main([*map(str, runs), "nfe=2", f"output={output}"])
    printed = capsys.readouterr().out
    assert "infer2, 40 pairs. Success: A succeeds more often than B" in printed
    found = sorted(path.name for path in output.iterdir())
    assert found == [f"comparison.{suffix}" for suffix in ("csv", "md", "png", "svg")]
    assert "infer2, 40 pairs" in (output / "comparison.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{a}"], "compare needs two run directories, found 1"),
        (["{a}", "{a}"], "is given twice: name two different runs"),
        (["{a}", "{tmp}"], "is not a run directory"),
        (["{a}", "{b}", "nfe=1,2,3"], "nfe must be one number, or one for each run"),
        (["{a}", "{cut}"], "episodes.jsonl, line 20 is cut off"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(runs, tmp_path, capfd, arguments, message):
    cut = write_evaluation(make_run(tmp_path / "cut", "cut"), 1) / "episodes.jsonl"
    cut.write_text(cut.read_text()[:-9])
    places = {"a": runs[0], "b": runs[1], "tmp": tmp_path, "cut": tmp_path / "cut"}
    with pytest.raises(SystemExit) as exit_:
        main([text.format(**places) for text in arguments] + [f"output={tmp_path / 'out'}"])
    printed = capfd.readouterr().err
    assert exit_.value.code == 2
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()
