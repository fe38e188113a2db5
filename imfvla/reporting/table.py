"""A table of text cells, written to the terminal, as Markdown, LaTeX and CSV."""

import csv
import io
import math
import re
import sys
from dataclasses import dataclass
from shutil import get_terminal_size
from textwrap import wrap

from rich.console import Console
from rich.text import Text

from imfvla.process.visible import styled, visible
from imfvla.reporting.escaping import (
    csv_cell,
    latex_cell,
    latex_text,
    markdown_cell,
    markdown_code,
    markdown_text,
)
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.terminal import fit

WIDE = 160  # characters a line where no terminal says how many it has
HEAD = 20  # characters of a line in the name of a column in LaTeX
NOTHING = "-"
MISSING, REFUSED = "missing", "refused"
FILL = "What is missing is filled by:"
VALUE = r"[-+<]?[\d.]+(?:/\d+)?[%×]?"  # a number, a count of so many, a share, a ratio, a bound
# alone or with its interval, and with its unit
TOO_FEW = "[too few]"  # for an interval
INTERVAL = rf" \[{VALUE}, {VALUE}\]|-{VALUE}| {re.escape(TOO_FEW)}"
NUMERIC = rf"{NOTHING}|{MISSING}|{REFUSED}|{VALUE}(?:{INTERVAL})?(?: ms| points)?"


@dataclass(frozen=True, slots=True)
class Table:
    """Title, column names, rows of as many cells, and paragraphs below.

    `keys` has, for each row, the names of its results, if any; where a row tells one result a cell, `cell_keys`
    has them for the cells behind the first, "" for none. `commands` fill what is missing, by name.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    keys: tuple[tuple[str, ...], ...] = ()
    commands: tuple[tuple[str, str], ...] = ()
    cell_keys: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.columns) for row in self.rows), self.title
        assert len(self.keys) in (0, len(self.rows)), self.title
        assert all(len(keys) == len(self.columns) - 1 for keys in self.cell_keys), self.title

    def markdown(self) -> str:
        """A Markdown table under a heading."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        body = "\n".join("| " + " | ".join(map(markdown_cell, line)) + " |" for line in lines)
        notes = "".join(f"\n{markdown_text(note)}\n" for note in self.notes)
        commands = "".join(
            f"- {markdown_text(', '.join(names))}: {markdown_code(command)}\n"
            for command, names in self.by_command().items()
        )
        missing = f"\n{FILL}\n\n{commands}" if commands else ""
        return f"## {markdown_text(self.title)}\n\n{body}\n{notes}{missing}"

    def csv(self) -> str:
        """Comma-separated values, names first."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        for row in (self.columns, *self.rows):
            writer.writerow(cell if re.fullmatch(NUMERIC, cell) else csv_cell(cell) for cell in row)
        return stream.getvalue()

    def latex(self) -> str:
        """A floating table for the packages booktabs and graphicx, scaled to the width of the text."""
        columns = "".join("r" if self.is_numeric(name) else "l" for name in self.columns)
        cells = (map(_latex_head, self.columns), *(map(latex_cell, row) for row in self.rows))
        lines = [" & ".join(row) + r" \\" for row in cells]
        notes = [rf"\par\smallskip\footnotesize {latex_text(note)}" for note in self.notes]
        return "\n".join(
            (
                r"\begin{table*}", r"\centering", rf"\caption{{{latex_text(self.title)}}}",
                rf"\resizebox{{\textwidth}}{{!}}{{\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule",
                *lines[1:], r"\bottomrule", r"\end{tabular}}", *notes, r"\end{table*}", "",
            )
        )  # fmt: skip

    def by_command(self) -> dict[str, list[str]]:
        """What each command fills."""
        grouped: dict[str, list[str]] = {}
        for name, command in self.commands:
            grouped.setdefault(command, []).append(name)
        return grouped

    def is_numeric(self, name: str) -> bool:
        """Whether all cells of a column are numbers, with or without interval, or placeholders for one."""
        index = self.columns.index(name)
        return all(re.fullmatch(NUMERIC, row[index]) for row in self.rows)

    def print(self, console: Console | None = None) -> None:
        """To the terminal, or to `console`, in the layout that fits its width."""
        if console is None:
            console = Console(file=styled(sys.stdout), width=get_terminal_size((WIDE, 0)).columns)
        columns, *rows = (tuple(map(visible, row)) for row in (self.columns, *self.rows))
        lines = fit(columns, rows, [self.is_numeric(name) for name in self.columns], console.width)
        console.print(Text(f"\n{visible(self.title)}", "bold"))
        for line in lines:
            console.print(Text(line.text, "bold" if line.is_heading else ""), soft_wrap=not line.is_heading)
        for note in self.notes:
            console.print(Text(f"\n{visible(note)}"))
        if self.commands:
            console.print(Text(f"\n{FILL}"))
        for command in self.by_command():
            console.print(Text(visible(command)), soft_wrap=True)  # unbroken, so that it can be copied


def _latex_head(name: str) -> str:
    """The name of a column, a long one in several lines."""
    lines = wrap(visible(name), HEAD, break_long_words=False, break_on_hyphens=False)
    lines = [latex_cell(line) for line in lines]
    return "".join(lines) if len(lines) < 2 else r"\shortstack[l]{" + r" \\ ".join(lines) + "}"


def number(value: float | None, digits: int) -> str:
    """`value` with so many decimals; a dash for None."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def with_interval(measured: Measured, digits: int, unit: str = "") -> str:
    """A number and its interval, as in "1.25 [1.00, 1.50]"; a dash where there is no number."""
    if measured.value is None:
        return NOTHING
    text = f"{measured.value:.{digits}f}{unit}"
    return f"{text} {interval(measured, digits, unit)}" if math.isfinite(measured.value) else text


def interval(measured: Measured, digits: int, unit: str = "") -> str:
    """As in "[75.6%, 89.9%]", or that too few episodes have none."""
    if measured.low is None or measured.high is None:
        return TOO_FEW
    return f"[{measured.low:.{digits}f}{unit}, {measured.high:.{digits}f}{unit}]"
