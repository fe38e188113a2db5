"""Tables of settings: rows of other tables, evaluated again with another clock, noise or condition.

In `experiments/tables.yaml` such a table names its rows (`of: settings`, `rows: [...]`), and its entries say the
settings: keys of an evaluation, each with a value or a list of values, of which all products count. `rows` in an entry
restricts it to some of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from imfvla.config.protocol import USUAL, EvaluationOptions, unusual
from imfvla.options import build, require
from imfvla.reporting.mapping.file import named, place_of, plain
from imfvla.reporting.mapping.row import TableRow

OF_CONDITION = {"condition": "name", "severity": "severity"}  # keys of an entry that are keys of `condition`
KEYS = (
    *("noise_scale", "noise", "candidates", "clock", "delay_ms", "meanwhile", "prefix", "runtime", "batch"),
    *OF_CONDITION,
)


def rows_of_settings(
    entries: Sequence[Any], table: str, names: Sequence[str], rows: Mapping[str, TableRow], path: Path
) -> list[TableRow]:
    """A row for each setting of each of the rows `names`, setting by setting. Raises UserError naming file and line."""
    of_table = {name: named(name, rows, f"{path}: tables.{table}.rows: unknown row") for name in names}
    found = []
    for number, entry in enumerate(entries, 1):
        where = place_of(entry, f"{table}, setting {number}", path)
        values = plain(entry, where)
        chosen = values.pop("rows", list(of_table))
        require(isinstance(chosen, list), f"{where}: rows", "a list of the table's rows", chosen)
        bases = [named(name, of_table, f"{where}: no row of the table") for name in chosen]
        for changes in _settings(values, where):
            found += [
                replace(
                    base,
                    name=f"{table}: {base.name}, {label(changes)}",
                    table=table,
                    changes=changes,
                    base=base.name,
                    paper=None,
                    where=where,
                )
                for base in bases
            ]
    return found


def label(changes: Sequence[tuple[str, Any]]) -> str:
    """A setting in words, as in "delay 120 ms, hold, bump 2"."""
    return ", ".join(unusual({**USUAL, "delay_steps": None, **dict(changes)}))


def world(changes: Sequence[tuple[str, Any]]) -> str:
    """`label` without how many episodes are played side by side, which changes their rounding alone."""
    return label([(key, value) for key, value in changes if key != "batch"])


def short_labels(rows: Sequence[TableRow]) -> tuple[dict[str, str], str]:
    """By the label of each row, its method and what not all rows have, such as "ACT (infer1)"; then what all have."""
    parts = {row.label: row.setting.split(", ") for row in rows}
    shared = [
        part for part in next(iter(parts.values()), []) if all(part in of_row for of_row in parts.values())
    ]
    found = {}
    for row in rows:
        own = ", ".join(part for part in parts[row.label] if part not in shared)
        found[row.label] = f"{row.method} ({own})" if own else row.method
    return found, ", ".join(shared)


def _settings(values: Mapping[str, Any], where: str) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Every product of an entry's values, as what differs from the usual protocol."""
    for key in values:
        named(key, dict.fromkeys(KEYS), f"{where}: unknown key")
    choices = [value if isinstance(value, list) else [value] for value in values.values()]
    for chosen in product(*choices):
        given = dict(zip(values, chosen, strict=True))
        condition = {OF_CONDITION[key]: given.pop(key) for key in OF_CONDITION if key in given}
        options = {"episodes": 1, "first_seed": 0, "nfe": [1], **given}
        asked = build(EvaluationOptions, options | ({"condition": condition} if condition else {}), where)
        changes = tuple(
            (key, value) for key, value in asked.in_protocol().items() if USUAL.get(key, value) != value
        )
        require(bool(changes), where, "another setting than that of the tables", dict(values))
        yield changes
