"""Columns of text as lines that fit a terminal, however narrow it is.

Where a table is too wide, rows with the same first cell become a group under that cell as a heading, and intervals go
below their numbers. If that is too wide too, each group is transposed: a line for each column, rows side by side.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from textwrap import wrap

GAP, INDENT = 2, 2  # blanks between columns, and before what stands under a heading
TEXT = 30  # characters a line of text in a table whose rows take several lines
INTERVAL = re.compile(r"(.*?) (\[.*,) (.*\].*)")

Row = Sequence[str]


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a table, and whether it names what is below."""

    text: str
    is_heading: bool = False


def fit(columns: Row, rows: Sequence[Row], numeric: Sequence[bool], width: int) -> list[Line]:
    """The table in the first layout that fits `width` characters; `numeric` columns are aligned to the right.

    Without rows there is nothing to lay out.
    """
    if not rows:
        return []
    layouts: tuple[tuple[Callable[..., Iterator[Line]], int], ...] = (
        (_whole, 1), (_grouped, 2), (_grouped, 3), (_turned, 1), (_turned, 2), (_turned, 3),
    )  # fmt: skip
    for arrange, height in layouts:
        lines = list(arrange(columns, rows, numeric, height))
        if max(len(line.text) for line in lines if not line.is_heading) <= width:
            return lines
    return list(_single(columns, rows, width))


def _whole(columns: Row, rows: Sequence[Row], numeric: Sequence[bool], _: int) -> Iterator[Line]:
    cells = [[[cell] for cell in row] for row in (columns, *rows)]
    head, *body = _grid(cells, numeric)
    yield from _ruled(head)
    yield from map(Line, (line for lines in body for line in lines))


def _grouped(columns: Row, rows: Sequence[Row], numeric: Sequence[bool], height: int) -> Iterator[Line]:
    """Groups under headings, where the first column is text."""
    start = 0 if numeric[0] or len(columns) == 1 else 1
    cells = [
        [
            _broken(cell, height) if n else wrap(cell, TEXT) or [""]
            for cell, n in zip(row, numeric, strict=True)
        ]
        for row in rows
    ]
    widest = [max(len(line) for row in cells for line in row[place]) for place in range(len(columns))]
    heads = [
        wrap(name, max(room, *map(len, name.split()))) for name, room in zip(columns, widest, strict=True)
    ]
    grid = _grid([row[start:] for row in (heads, *cells)], numeric[start:])
    yield from _ruled(grid[0])
    for row, lines, above in zip(rows, grid[1:], (None, *rows), strict=False):
        if start and (above is None or row[0] != above[0]):
            if above is not None:
                yield Line("")
            yield Line(row[0], is_heading=True)
        yield from (Line(" " * INDENT * start + line) for line in lines)


def _turned(columns: Row, rows: Sequence[Row], numeric: Sequence[bool], height: int) -> Iterator[Line]:
    for number, (name, group) in enumerate(groupby(rows, itemgetter(0))):
        members = list(group)
        if number:
            yield Line("")
        yield Line(f"{columns[0]} {name}" if numeric[0] else name, is_heading=True)
        sides = zip(*(row[1:] for row in members), strict=True)
        cells = [
            [[label], *(_broken(cell, height) for cell in side)]
            for label, side in zip(columns[1:], sides, strict=True)
        ]
        if cells:
            grid = _grid(cells, [False, *[len(members) > 1] * len(members)])
            yield from (Line(" " * INDENT + line) for lines in grid for line in lines)


def _single(columns: Row, rows: Sequence[Row], width: int) -> Iterator[Line]:
    """One row after the other, a line or more for each of its cells."""
    label_width = min(max(map(len, columns)), width // 2)
    for number, row in enumerate(rows):
        if number:
            yield Line("")
        for place, (name, cell) in enumerate(zip(columns, row, strict=True)):
            labels = wrap(name, label_width) or [""]
            values = wrap(cell, max(width - label_width - GAP, 1)) or [""]
            for line in _grid([[labels, values]], [False, False], [label_width, 0])[0]:
                yield Line(line, is_heading=place == 0)


def _broken(cell: str, height: int) -> list[str]:
    """A number above its interval, of which each end has a line where three are given."""
    found = INTERVAL.fullmatch(cell)
    if found is None or height == 1:
        return [cell]
    value, low, high = found.groups()
    return [value, f"{low} {high}"] if height == 2 else [value, low, high]


def _grid(
    rows: Sequence[Sequence[Sequence[str]]], numeric: Sequence[bool], least: Sequence[int] | None = None
) -> list[list[str]]:
    """Lines of each row, whose cells are lines; columns as wide as their widest."""
    least = least or [0] * len(numeric)
    widths = [
        max(room, *(len(line) for row in rows for line in row[place])) for place, room in enumerate(least)
    ]
    found = []
    for row in rows:
        lines = []
        for number in range(max(map(len, row))):
            parts = [cell[number] if number < len(cell) else "" for cell in row]
            aligned = [
                part.rjust(width) if right else part.ljust(width)
                for part, width, right in zip(parts, widths, numeric, strict=True)
            ]
            lines.append((" " * GAP).join(aligned).rstrip())
        found.append(lines)
    return found


def _ruled(head: Sequence[str]) -> Iterator[Line]:
    yield from map(Line, head)
    yield Line("-" * max(map(len, head)))
