"""Tables of methods: a line for each, its tasks in columns, and what a wrong line is told."""

import csv
import io
import json
from pathlib import Path

import pytest
from synthetic_runs import answer_row

from imfvla.errors import UserError
from imfvla.reporting.answers import Sources
from imfvla.reporting.mapping import PATH, read_mapping
from imfvla.reporting.mapping.methods import MethodEntry
from imfvla.reporting.methods_table import methods_table
from imfvla.reporting.results import Result

MAPPING = read_mapping()
BY_NAME = {row.name: row for row in MAPPING.rows}
TEXT = PATH.read_text()
NAMES = ("transfer_imf_infer1", "dwell_imf_infer1", "transfer_l1", "dwell_l1")


def trained(folder: Path, train_s: float) -> None:
    """Notes the time of a training in the run of an evaluation."""
    metrics = folder.parents[1] / "metrics.jsonl"
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    lines[-1]["train_s"] = train_s
    metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_a_line_has_success_on_every_task_and_the_means_of_its_policies(tmp_path):
    for seed, seconds in ((0, 60.0), (1, 120.0)):
        trained(answer_row(tmp_path, BY_NAME[NAMES[0]], seed=seed, latency_ms=6.0), seconds)
    trained(answer_row(tmp_path, BY_NAME[NAMES[1]], latency_ms=6.0), 180.0)
    sources = Sources([tmp_path])
    results = [Result.of(sources.answer(BY_NAME[name], MAPPING)) for name in NAMES]
    imf, l1 = ({BY_NAME[name].table: BY_NAME[name] for name in names} for names in (NAMES[:2], NAMES[2:3]))
    entries = [MethodEntry("needs", "iMF", imf), MethodEntry("needs", "L1", l1)]
    document = methods_table(MAPPING.table("needs"), entries, MAPPING.of_rows, results)
    assert document.shown.columns == (
        "Method", "Object transfer", "A hand-over whose moment is hidden", "Chunk ms", "Training min"
    )  # fmt: skip
    imf, l1 = document.shown.rows
    share = 100 * sum(row["success"] for row in results[0].episodes) / 200
    assert imf[1].startswith(f"{share:.1f} [")
    assert imf[1].endswith("], 2 seeds")
    assert "seeds" not in imf[2]
    assert 6.0 < float(imf[3]) < 6.7  # the fakes take up to a tenth more
    assert imf[4] == "2.0"
    assert l1 == ("L1", "missing", "-", "-", "-")
    assert document.shown.cell_keys == ((*NAMES[:2], "", ""), (NAMES[2], "", "", ""))
    assert [name for name, _ in document.shown.commands] == [BY_NAME[NAMES[2]].label]
    lines = list(csv.DictReader(io.StringIO(document.data.csv())))
    assert [(line["row"], line["training_seeds"], line["status"]) for line in lines] == [
        (NAMES[0], "0 1", "measured"), (NAMES[1], "0", "measured"), (NAMES[2], "", "missing"),
    ]  # fmt: skip
    assert float(lines[0]["success_share"]) == pytest.approx(share / 100)


def test_a_row_in_a_setting_stands_in_the_column_of_its_table(tmp_path):
    (line,) = (
        line for line in MAPPING.of_methods("needs") if line.method == "iMF-AttnRes, 1 evaluation, zero noise"
    )
    answer_row(tmp_path, BY_NAME["transfer_imf_infer1"], quality=0.2)
    answer_row(tmp_path, BY_NAME["transfer_imf_infer1"], quality=0.9, noise="zero")
    sources = Sources([tmp_path])
    results = [Result.of(sources.answer(row, MAPPING)) for row in line.rows.values()]
    document = methods_table(MAPPING.table("needs"), [line], MAPPING.of_rows, results)
    transfer = document.shown.columns.index("Object transfer")
    assert float(document.shown.rows[0][transfer].split()[0]) > 60


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "rows: [socket800_l1, transfer_l1, dwell_l1]",
            "rows: [socket800_l1, transfer_l1, dwell_l3]",
            r"needs, row 18: unknown row 'dwell_l3'",
        ),
        (
            "rows: [socket800_l1, transfer_l1, dwell_l1]",
            "rows: [transfer_l1, transfer_l2]",
            r"rows must be one row of each table",
        ),
        (
            "rows: [socket800_l1, transfer_l1, dwell_l1]",
            'rows: [transfer_imf_infer1, "transfer_zero: transfer_imf_infer1, zero noise"]',
            r"rows must be one row of each table",
        ),
        (
            "rows: [socket800_l1, transfer_l1, dwell_l1]",
            "rows: []",
            r"row 18: rows must be one row of each table at most",
        ),
        ('method: "L1 regression", rows', "rows", r"needs, row 18\.method: give it a value"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, old, new, message):
    path = tmp_path / "tables.yaml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(UserError, match=message):
        read_mapping(path)
