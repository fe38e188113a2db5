"""What other papers print stands at the head of a task's table, with its source."""

from imfvla.reporting.published import published_rows
from imfvla.reporting.tables import COLUMNS, row_table


def test_every_line_has_a_rate_and_a_source():
    (row,) = published_rows("aloha_transfer")
    assert (row.method, row.success_percent) == ("ACT", 86)
    assert row.source.startswith("arXiv 2304.13705")
    assert published_rows("socket") == ()


def test_a_published_rate_heads_the_table():
    table = row_table("a title", [], published=published_rows("aloha_insertion")).shown
    (cells,) = table.rows
    assert cells[COLUMNS.index("Source")] == "published"
    assert cells[COLUMNS.index("Success-like")] == "32%"
    assert "Published: ACT, arXiv 2304.13705." in table.notes
