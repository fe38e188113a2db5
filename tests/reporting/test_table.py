"""One table in four formats."""

import csv
import io

import pytest
from rich.console import Console

from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.table import FILL, Table, interval, number, with_interval

TABLE = Table(
    "Title",
    ("Row", "Value", "Share"),
    (("a & b", "1.25 [1.00, 1.50]", "84/100 [75.6%, 89.9%]"), ("x|y", "missing", "-")),
    notes=("A note: 95% of 2_3.",),
    commands=(("x|y", "python -m a"), ("z", "python -m a")),
)


def test_markdown():
    assert TABLE.markdown() == (
        "## Title\n\n| Row | Value | Share |\n| --- | --- | --- |\n"
        "| a & b | 1.25 [1.00, 1.50] | 84/100 [75.6%, 89.9%] |\n| x\\|y | missing | - |\n\n"
        "A note: 95% of 2_3.\n\nWhat is missing is filled by:\n\n- x|y, z: `python -m a`\n"
    )


def test_csv_is_read_back():
    assert list(csv.reader(io.StringIO(TABLE.csv()))) == [list(row) for row in (TABLE.columns, *TABLE.rows)]


def test_latex_has_as_many_cells_in_every_line_and_no_special_character_left():
    text = TABLE.latex()
    assert r"{\begin{tabular}{lrr}" in text
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert [line.replace(r"\&", "").count("&") for line in lines] == [2, 2, 2]
    assert r"a \& b & 1.25 [1.00, 1.50] & 84/100 [75.6\%, 89.9\%] \\" in lines
    assert r"A note: 95\% of 2\_3." in text
    assert text.count(r"\begin") == text.count(r"\end")


def test_a_long_name_of_a_column_is_broken_in_latex():
    text = Table("Title", ("Setting", "Flow, high-noise times (infer2)"), (("unchanged", "90/100"),)).latex()
    assert "Setting & \\shortstack[l]{Flow, high-noise \\\\ times (infer2)} \\\\\n" in text


def test_text_has_the_commands_once():
    console = Console(record=True, width=100, file=io.StringIO())
    TABLE.print(console)
    text = console.export_text()
    assert FILL in text
    assert text.count("python -m a") == 1


@pytest.mark.parametrize(
    ("cell", "is_numeric"),
    [
        ("-", True), ("missing", True), ("1544.75", True), ("84/100", True), ("+15 [+1.0, +29.5]", True),
        ("1.76× [1.50×, 2.10×]", True), ("15.0-85.0%", True), ("<0.001", True),
        ("1.25 [too few]", True), ("+2.0 [too few] points", True),
        ("socket_l1", False), ("1 of 2", False),
    ],
)  # fmt: skip
def test_numbers_are_told_from_text(cell, is_numeric):
    assert Table("", ("a",), ((cell,),)).is_numeric("a") is is_numeric


def test_numbers_with_and_without_interval():
    assert with_interval(Measured(1.234, 1.0, 1.5), 2) == "1.23 [1.00, 1.50]"
    assert with_interval(Measured(1.234), 1, "×") == "1.2× [too few]"
    assert with_interval(Measured(float("inf")), 1, "×") == "inf×"
    assert with_interval(Measured(None), 1) == number(None, 1) == "-"
    assert interval(Measured(0.5, 0.25, 0.75).scaled(100), 1, "%") == "[25.0%, 75.0%]"
    assert interval(Measured(1.0), 1) == "[too few]"
