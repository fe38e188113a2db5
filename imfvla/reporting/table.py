"""A table as text cells, written for people, for Markdown and for spreadsheets."""

import csv
import io
import re
import sys
from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

WIDE = 160  # characters a line where no terminal says how many it has
NOTHING = "-"
NUMERIC = r"-|[-+]?[\d.]+[-/%×\d.]*"  # a dash, a number, a count of so many, an interval


@dataclass(frozen=True, slots=True)
class Table:
    """Title, column names, rows of as many cells, and a note below."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.columns) for row in self.rows), self.title

    def markdown(self) -> str:
        """A Markdown table under a heading."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        body = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        return f"## {self.title}\n\n{body}\n" + (f"\n{self.note}\n" if self.note else "")

    def csv(self) -> str:
        """Comma-separated values, names first."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerows([self.columns, *self.rows])
        return stream.getvalue()

    def print(self, console: Console | None = None) -> None:
        """To the terminal, or to `console`."""
        if console is None:
            console = Console(width=None if sys.stdout.isatty() else WIDE)
        title, note = Text(self.title, "bold"), Text(self.note) if self.note else None
        table = RichTable(
            title=title, caption=note, box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left"
        )
        for name in self.columns:
            table.add_column(name, justify="right" if _is_numeric(name, self) else "left", overflow="fold")
        for row in self.rows:
            table.add_row(*map(Text, row))
        console.print(table)


def number(value: float | None, digits: int) -> str:
    """With so many digits after the point, a dash for None."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def _is_numeric(name: str, table: Table) -> bool:
    index = table.columns.index(name)
    return all(re.fullmatch(NUMERIC, row[index]) for row in table.rows)
