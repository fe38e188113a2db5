"""Tables in terminals of every width: nothing is cut off or lost, and names stay in one piece while they can."""

import io

import pytest
from rich.console import Console

from imfvla.reporting.table import Table

COLUMNS = (
    "Row",
    "nfe",
    "Source",
    "Avg. reward",
    "Median",
    "Success-like",
    "Latency ms",
    "Inf. FPS",
    "Control FPS",
)
NAMES = ("Diffusion-style VLA (infer100, ph32, exec16, 150k)", "ACT (action chunking)")
PAPER = ("1", "paper", "1275.22", "1490.5", "0/100", "16.186", "-", "-")
OURS = (
    "1", "ours", "1020.03 [824.08, 1220.83]", "1466.0 [1001.0, 1571.0]", "51/100 [41.3%, 60.6%]",
    "107.297 [107.075, 107.535]", "137.05 [132.71, 141.34]", "686",
)  # fmt: skip
TABLE = Table("Title", COLUMNS, tuple((name, *row) for name in NAMES for row in (PAPER, OURS)))
WIDTHS = (250, 160, 100, 80, 40, 30)


def printed(table: Table, width: int) -> list[str]:
    console = Console(record=True, width=width, file=io.StringIO())
    table.print(console)
    return [line.rstrip() for line in console.export_text().splitlines()]


@pytest.mark.parametrize("width", WIDTHS)
def test_every_line_fits_and_every_word_is_there(width):
    lines = printed(TABLE, width)
    assert max(map(len, lines)) <= width
    text = "".join("".join(lines).split())
    for row in (COLUMNS[1:], *TABLE.rows):
        for word in " ".join(row).split():
            assert word in text


@pytest.mark.parametrize("width", WIDTHS[:4])
def test_names_are_not_broken(width):
    text = "\n".join(printed(TABLE, width))
    assert all(name in text for name in NAMES)


def test_a_wide_terminal_has_a_line_for_each_row():
    assert len(printed(TABLE, 250)) == 1 + 1 + 2 + 4  # blank, title, head with its rule, rows


def test_rows_of_a_name_stand_below_it_with_their_intervals_below_the_numbers():
    lines = printed(TABLE, 120)
    first = lines.index(NAMES[0])
    assert lines[first + 1].split() == list(PAPER)
    assert lines[first + 2].split() == [
        "1",
        "ours",
        "1020.03",
        "1466.0",
        "51/100",
        "107.297",
        "137.05",
        "686",
    ]
    assert lines[first + 3].startswith(" " * 10)
    assert "[824.08, 1220.83]  [1001.0, 1571.0]" in lines[first + 3]


def test_a_narrow_terminal_has_paper_and_ours_side_by_side():
    lines = printed(TABLE, 60)
    assert "Latency ms     16.186  107.297 [107.075, 107.535]" in " ".join(lines)


def test_a_table_of_one_column_or_of_no_row_is_printed():
    assert printed(Table("T", ("a",), (("x",),)), 40)[2:] == ["a", "-", "x"]
    assert printed(Table("T", COLUMNS, (), ("There are none.",)), 40)[1:] == ["T", "", "There are none."]
