"""Tables of settings: what tables.yaml says, which evaluations answer, and what is compared with what."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from synthetic_runs import answer_row

from imfvla.command.planning import jobs_of_rows
from imfvla.config.assets import folder
from imfvla.config.protocol import MEASURED
from imfvla.errors import UserError
from imfvla.figures.settings import success_by_delay, success_by_severity
from imfvla.reporting.answers import Sources
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.mapping.row import TableRow
from imfvla.reporting.mapping.settings import label, rows_of_settings, short_labels
from imfvla.reporting.media import Media
from imfvla.reporting.notes import label as comparison_label
from imfvla.reporting.page import page
from imfvla.reporting.results import Result
from imfvla.reporting.settings_table import settings_table

MAPPING = read_mapping()
BY_NAME = {row.name: row for row in MAPPING.rows}
BASES = ("transfer_imf_infer1", "transfer_l1")
RUNNING = {"clock": "running", "delay_ms": 120, "delay_steps": 6, "meanwhile": "continue"}


def rows(*entries: dict, table: str = "table4") -> list:
    return rows_of_settings(list(entries), table, BASES, BY_NAME, Path("tables.yaml"))


def test_an_entry_is_every_product_of_its_values_for_every_row():
    found = rows(
        {"clock": "running", "delay_ms": [20, 40], "meanwhile": ["hold", "continue"]},
        {"condition": "bump", "severity": [1, 3], "rows": ["transfer_l1"]},
    )
    assert [row.name for row in found[:3]] == [
        "table4: transfer_imf_infer1, delay 20 ms, hold",
        "table4: transfer_l1, delay 20 ms, hold",
        "table4: transfer_imf_infer1, delay 20 ms, continue",
    ]
    assert [row.name for row in found[8:]] == ["table4: transfer_l1, bump 1", "table4: transfer_l1, bump 3"]
    assert dict(found[2].changes) == {"clock": "running", "delay_ms": 20, "meanwhile": "continue"}
    assert found[2].options() == ["clock=running", "delay_ms=20", "meanwhile=continue"]
    assert found[9].options("evaluation.") == ["condition=bump", "evaluation.condition.severity=3"]
    assert label(found[9].changes) == "bump 3"


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"speed": 2}, r"table4, setting 1: unknown key 'speed'"),
        ({"clock": "running", "delay_ms": -1}, r"setting 1\.delay_ms must be measured, or a number"),
        ({"condition": "fog", "severity": 1}, r"condition\.name must be one of"),
        ({"condition": "bump"}, r"condition\.severity must be 1, 2 or 3"),
        ({"clock": "paused"}, r"must be another setting than that of the tables"),
        ({"rows": ["socket_act"], "noise": "held"}, r"no row of the table 'socket_act'"),
    ],
)
def test_wrong_settings_are_named(entry, message):
    with pytest.raises(UserError, match=message):
        rows(entry)


def fills(job: list[str], row: TableRow) -> bool:
    """Whether a job of a sweep makes the row's evaluation, whatever its training seeds."""
    given = dict(override.split("=", 1) for override in job)
    asked = [
        f"+exp={row.experiment}",
        *row.overrides,
        *(f"evaluation.{key}={value}" for key, value in row.changes),
    ]
    return set(asked) <= set(job) and row.nfe in yaml.safe_load(given["evaluation.nfe"])


def test_every_table_of_settings_is_filled_by_its_sweep():
    for table in MAPPING.of_settings:
        content = yaml.safe_load((folder("conf") / "sweep" / f"{table.sweep}.yaml").read_text())
        if content["tables"]:
            assert content["tables"] == [table.name]
        else:
            assert all(
                any(fills(job, row) for job in content["jobs"]) for row in MAPPING.of_table(table.name)
            )
    jobs = jobs_of_rows(MAPPING.of_table("table4"))
    assert all("evaluation.clock=running" in job or "condition=bump" in job for job in jobs)
    assert len(jobs) == len(set(jobs))


def test_a_row_in_a_setting_is_compared_under_the_setting_s_name():
    same, *_, with_l1 = MAPPING.of_comparisons("transfer_zero_compared")
    assert with_l1.row.changes == (("noise", "zero"),)
    assert comparison_label(with_l1).startswith(
        "iMF-AttnRes, two stages (infer1, zero noise) vs L1 regression"
    )
    assert "zero noise" not in comparison_label(same)


@pytest.fixture
def results(tmp_path) -> list[Result]:
    """Both rows in the unchanged world; the first one with a delay too, and with a bump."""
    for name, quality in zip(BASES, (0.8, 0.6), strict=True):
        answer_row(tmp_path, BY_NAME[name], quality=quality)
    answer_row(tmp_path, BY_NAME[BASES[0]], quality=0.3, **RUNNING)
    answer_row(tmp_path, BY_NAME[BASES[0]], quality=0.8, condition="bump", severity=2)
    found = rows(
        {key: value for key, value in RUNNING.items() if key != "delay_steps"},
        {"condition": "bump", "severity": 2},
    )
    sources = Sources([tmp_path])
    return [Result.of(sources.answer(row, MAPPING)) for row in (*(BY_NAME[name] for name in BASES), *found)]


TABLE = replace(MAPPING.table("table4"), rows=BASES)


def test_only_an_evaluation_in_that_setting_answers(results):
    assert [result.is_missing for result in results] == [False, False, False, True, False, True]
    assert "clock=running delay_ms=120 meanwhile=continue" in results[3].answer.command
    assert "condition=bump condition.severity=2" in results[5].answer.command
    assert len({result.first.folder for result in results if not result.is_missing}) == 4


def test_lines_are_settings_and_differences_are_from_the_same_starts(results):
    document = settings_table(TABLE, results)
    unchanged, delayed, bumped = document.shown.rows
    counts = [sum(row["success"] for row in result.episodes) for result in results]
    returns = [
        f"{np.mean([row['total_reward'] for row in result.episodes] or [0]):.0f}" for result in results
    ]
    assert unchanged == ("unchanged", f"{counts[0]}/100, {returns[0]}", f"{counts[1]}/100, {returns[1]}")
    late = f"{counts[2]}/100 ({counts[2] - counts[0]:+d}*), {returns[2]}"
    assert delayed == ("delay 120 ms, continue", late, "missing")
    assert bumped == ("bump 2", f"{counts[4]}/100 (+0), {returns[4]}", "missing")
    assert "fewer successes than in the first line in 1 of 2 settings" in " ".join(document.shown.notes)
    assert document.shown.commands == (("table4", "python -m imfvla.train -m +sweep=clock"),)
    lines = list(csv.DictReader(io.StringIO(document.data.csv())))
    assert [(line["setting"], line["status"]) for line in lines] == [
        ("unchanged", "measured"), ("unchanged", "measured"), ("delay 120 ms, continue", "measured"),
        ("delay 120 ms, continue", "missing"), ("bump 2", "measured"), ("bump 2", "missing"),
    ]  # fmt: skip
    assert float(lines[2]["success_difference"]) == pytest.approx((counts[2] - counts[0]) / 100)
    assert float(lines[2]["success_difference_low"]) < float(lines[2]["success_difference"])
    assert float(lines[2]["p_holm"]) == pytest.approx(2 * float(lines[2]["p"]), rel=1e-3)
    assert lines[2]["delay_steps"] == "6"


def test_a_method_that_is_played_side_by_side_has_the_lines_of_the_others(tmp_path):
    entries = (
        {"condition": "bump", "severity": 2, "rows": [BASES[0]]},
        {"condition": "bump", "severity": 2, "batch": 8, "rows": [BASES[1]]},
    )
    sources = Sources([tmp_path])
    found = [
        Result.of(sources.answer(row, MAPPING))
        for row in (*(BY_NAME[name] for name in BASES), *rows(*entries))
    ]
    document = settings_table(TABLE, found)
    assert [line[0] for line in document.shown.rows] == ["unchanged", "bump 2"]
    assert "L1 regression: 8 episodes side by side in 1 of 1 settings, which" in " ".join(
        document.shown.notes
    )
    assert [line["setting"] for line in csv.DictReader(io.StringIO(document.data.csv()))][2:] == [
        "bump 2",
        "bump 2, batch 8",
    ]


def test_cells_lead_to_their_rows_and_rows_show_their_videos(results, tmp_path):
    folder = results[2].first.folder
    (folder / "best_seed1.mp4").write_bytes(b"")
    results[2].first.summary["recordings"] = {"best": {"seed": 1, "return": 2.0, "file": "best_seed1.mcap"}}
    text = page([settings_table(TABLE, results).shown], [], results, Media(tmp_path, is_copied=False))
    anchor = "row-table4--transfer_imf_infer1--delay-120-ms--continue"
    assert text.count(f'<a href="#{anchor}">') == 1
    assert text.count("<video") == 1
    details = text[text.index(f'<details id="{anchor}">') :]
    assert details.startswith(
        f'<details id="{anchor}"><summary>{results[2].row.label}, nfe 1, delay 120 ms, continue'
    )
    assert 0 < details.index("<video") < details.index("</dl>")
    assert f'<a href="#row-{BASES[0]}">' in text  # the unchanged world
    assert 'href="#row-table4--transfer_l1' not in text  # not measured


def test_whether_an_event_came_is_counted(tmp_path):
    told = Result.of(answered_bump(tmp_path, [True] * 97 + [False] * 3))
    document = settings_table(TABLE, [*(Result.of(answer) for answer in unchanged(tmp_path)), told])
    assert any(
        note.startswith("bump 2: the event came in 97 of 100 episodes") for note in document.shown.notes
    )
    assert "every episode" not in " ".join(document.shown.notes)
    lines = list(csv.DictReader(io.StringIO(document.data.csv())))
    assert lines[-1]["condition_happened"] == "97"
    assert lines[0]["condition_happened"] == ""


def test_only_training_seeds_that_were_played_in_a_setting_are_compared(tmp_path):
    for seed in (0, 1):
        answer_row(tmp_path, BY_NAME[BASES[0]], seed=seed, quality=0.9 - 0.5 * seed)
    answer_row(tmp_path, BY_NAME[BASES[0]], quality=0.9, **RUNNING)
    sources = Sources([tmp_path])
    (late,) = rows({key: RUNNING[key] for key in ("clock", "delay_ms", "meanwhile")} | {"rows": [BASES[0]]})
    found = [Result.of(sources.answer(row, MAPPING)) for row in (*(BY_NAME[name] for name in BASES), late)]
    assert len(found[0].episodes) == 200
    unchanged, delayed = settings_table(TABLE, found).shown.rows
    count = sum(row["success"] for row in found[2].episodes)
    assert unchanged[1].startswith(f"{count}/100")
    assert delayed[1].startswith(f"{count}/100 (+0)")


def test_the_first_line_has_every_training_seed_of_any_setting(tmp_path):
    for seed in (0, 1):
        answer_row(tmp_path, BY_NAME[BASES[0]], seed=seed)
        answer_row(tmp_path, BY_NAME[BASES[0]], seed=seed, **RUNNING)
    answer_row(tmp_path, BY_NAME[BASES[0]], **RUNNING | {"meanwhile": "hold"})
    sources = Sources([tmp_path])
    both = rows({"clock": "running", "delay_ms": 120, "meanwhile": ["continue", "hold"], "rows": [BASES[0]]})
    found = [Result.of(sources.answer(row, MAPPING)) for row in (*(BY_NAME[name] for name in BASES), *both)]
    shown = settings_table(TABLE, found).shown
    assert ["/200" in line[1] for line in shown.rows] == [True, True, False]
    assert any(note.startswith("Settings with fewer episodes") for note in shown.notes)


def test_events_that_always_came_are_one_sentence(tmp_path):
    told = Result.of(answered_bump(tmp_path, [True] * 100))
    document = settings_table(TABLE, [*(Result.of(answer) for answer in unchanged(tmp_path)), told])
    assert "The event came in every episode of: bump 2." in document.shown.notes


def unchanged(root):
    for name in BASES:
        answer_row(root, BY_NAME[name])
    return [Sources([root]).answer(BY_NAME[name], MAPPING) for name in BASES]


def answered_bump(root, happened):
    folder = answer_row(root, BY_NAME[BASES[0]], condition="bump", severity=2)
    lines = (folder / "episodes.jsonl").read_text().splitlines()
    told = [
        json.loads(line) | {"condition_happened": came} for line, came in zip(lines, happened, strict=True)
    ]
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in told))
    (row,) = rows({"condition": "bump", "severity": 2, "rows": [BASES[0]]})
    return Sources([root]).answer(row, MAPPING)


def test_columns_name_what_tells_them_apart_and_what_all_have_is_said_once():
    names, shared = short_labels([BY_NAME[name] for name in ("transfer_imf_infer1", "transfer_flow_infer2")])
    assert list(names.values()) == ["iMF-AttnRes, two stages (infer1)", "Flow, high-noise times (infer2)"]
    assert shared == "ph32, exec16"
    assert short_labels([BY_NAME["transfer_l1"]]) == (
        {BY_NAME["transfer_l1"].label: "L1 regression"}, "infer1, ph32, exec16"
    )  # fmt: skip
    assert short_labels([]) == ({}, "")


def test_no_two_lines_of_a_figure_look_the_same(results):
    """Of the rows of table 4 with a delay in ms, each with the results of one."""
    late = [row for row in MAPPING.of_table("table4") if dict(row.changes).get("delay_ms") != MEASURED]
    figure = success_by_delay([Result.of(replace(results[2].answer, row=row)) for row in late])
    bars = {found.get_label(): found.lines[0] for axes in figure.axes for found in axes.containers}
    looks = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in bars.values()}
    assert len(looks) == len(bars) == len({(row.label, dict(row.changes).get("prefix")) for row in late})


def test_what_is_not_measured_yet_is_said(tmp_path):
    sources = Sources([tmp_path])
    missing = [
        Result.of(sources.answer(row, MAPPING))
        for row in (*(BY_NAME[name] for name in BASES), *rows({"noise": "held"}))
    ]
    document = settings_table(TABLE, missing)
    assert {cell for row in document.shown.rows for cell in row[1:]} == {"missing"}
    for draw in (success_by_delay, success_by_severity):
        assert "nothing measured yet" in {
            text.get_text() for axes in draw(missing).axes for text in axes.texts
        }


def test_figures_have_a_line_for_every_method_that_is_measured_in_another_world(results):
    delays = success_by_delay(results)
    titles = [axes.get_title(loc="left") for axes in delays.axes]
    assert titles == [
        "the robot holds meanwhile", "the robot continues meanwhile", "", "",
        "the robot holds meanwhile, bump", "the robot continues meanwhile, bump", "", "",
    ]  # fmt: skip
    assert [len(axes.containers) for axes in delays.axes] == [1] * 8
    for axes, metric, scale in ((delays.axes[1], "success_share", 100), (delays.axes[3], "avg_return", 1)):
        (line,) = (bars.lines[0] for bars in axes.containers if len(bars.lines[0].get_xdata()) == 2)
        assert np.diff(line.get_xdata()) == pytest.approx(120)
        expected = [scale * results[index].metric(metric).value for index in (0, 2)]
        assert line.get_ydata().tolist() == pytest.approx(expected)
    row = replace(results[2].row, changes=(*results[2].row.changes, ("prefix", "guided")))
    guided = Result.of(replace(results[2].answer, row=row))
    labels = success_by_delay([*results, guided]).axes[1].get_legend_handles_labels()[1]
    assert labels[-1] == f"{results[2].row.method}, guided prefix"
    severities = success_by_severity(results)
    assert severities.axes[0].get_title(loc="left") == "bump"
    assert len(severities.axes[0].containers) == 1
