"""A table of methods: what each reaches on every task, how long a chunk takes, and how long its training took."""

from collections.abc import Sequence
from statistics import median

from imfvla.reporting.cells import BY_NAME
from imfvla.reporting.curves import training_minutes
from imfvla.reporting.mapping.methods import MethodEntry
from imfvla.reporting.mapping.tables import TableTitle
from imfvla.reporting.results import Result
from imfvla.reporting.table import MISSING, NOTHING, Table, number, with_interval
from imfvla.reporting.tables import Document

LATENCY, SHARE = BY_NAME["inference_ms_median"], BY_NAME["success_share"]
NOTES = (
    "Success in percent with its 95% interval, and the number of training seeds where it is not one. Chunk: median "
    "over all replannings of these rows. Training: mean time of these policies. Both times are of the machines that "
    "these rows came from, which often had two of them at a time, a core each.",
)


def methods_table(
    table: TableTitle, methods: Sequence[MethodEntry], of: Sequence[TableTitle], results: Sequence[Result]
) -> Document:
    """Methods in lines, and the tables `of` their rows in columns. `results` are of all rows."""
    named = {result.name: result for result in results}
    places = [place for place in of if any(place.name in entry.rows for entry in methods)]
    rows, data, keys, commands = [], [], [], {}
    for entry in methods:
        found = {place: named[row.name] for place, row in entry.rows.items()}
        measured = [result for result in found.values() if not result.is_missing]
        ms = median(_chunk_times(measured)) if measured else None
        minutes = training_minutes({one.evaluation.run for result in measured for one in result.evaluated})
        cells = [found.get(place.name) for place in places]
        rows.append((entry.method, *map(_success, cells), number(ms, 1), number(minutes, 1)))
        filled = [(place, result) for place, result in zip(places, cells, strict=True) if result]
        data += [_data(entry, place, result, minutes) for place, result in filled]
        keys.append((*(result.name if result else "" for result in cells), "", ""))
        commands |= {r.row.label: r.answer.command for r in found.values() if r.is_missing}
    titles = [place.title.split(": ")[-1] for place in places]
    columns = ("Method", *(title[:1].upper() + title[1:] for title in titles), "Chunk ms", "Training min")
    shown = Table(
        table.title, columns, tuple(rows), NOTES, commands=tuple(commands.items()), cell_keys=tuple(keys)
    )
    return Document(shown, Table(table.title, COLUMNS, tuple(data)))


COLUMNS = (
    "method", "table", "row", "training_seeds", "success_share", "success_share_low", "success_share_high",
    "latency_ms_median", "training_min", "status",
)  # fmt: skip


def _success(result: Result | None) -> str:
    if result is None:
        return NOTHING
    if result.is_missing:
        return MISSING
    seeds = len(result.evaluated)
    text = with_interval(result.metric(SHARE.name).scaled(100), 1)
    return text if seeds == 1 else f"{text}, {seeds} seeds"


def _data(entry: MethodEntry, place: TableTitle, result: Result, minutes: float | None) -> tuple[str, ...]:
    share = result.metric(SHARE.name)
    numbers = (share.value, share.low, share.high)
    return (
        entry.method,
        place.name,
        result.name,
        " ".join(str(found.evaluation.training_seed) for found in result.evaluated),
        *("" if value is None else f"{value:.{SHARE.data_digits}f}" for value in numbers),
        "" if result.is_missing else f"{result.metric(LATENCY.name).value:.{LATENCY.data_digits}f}",
        "" if minutes is None else f"{minutes:.2f}",
        MISSING if result.is_missing else "measured",
    )


def _chunk_times(results: Sequence[Result]) -> list[float]:
    """A median for each policy [ms]."""
    return [LATENCY.of(found.episodes) for result in results for found in result.evaluated]
