"""A table of settings: success in each, and what it loses against the unchanged row, start by start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from imfvla.reporting.mapping.settings import label, short_labels, world
from imfvla.reporting.mapping.tables import TableTitle
from imfvla.reporting.metrics import condition_happened
from imfvla.reporting.results import Result
from imfvla.reporting.statistics.contrasts import Contrast, return_difference, success_difference
from imfvla.reporting.statistics.measured import Measured
from imfvla.reporting.statistics.pairs import Pairs, refusal
from imfvla.reporting.statistics.significance import holm
from imfvla.reporting.table import MISSING, REFUSED, Table, interval
from imfvla.reporting.tables import Document

UNCHANGED = "unchanged"
ALPHA = 0.05
METRICS = ("success_share", "avg_return", "chunk_jump", "inference_ms_mean")
COLUMNS = (
    "row", "setting", "nfe", "episodes", "success",
    *(f"{name}{end}" for name in METRICS for end in ("", "_low", "_high")),
    "delay_steps", "latency_alone_ms", "condition_happened",
    "success_difference", "success_difference_low", "success_difference_high", "p", "p_holm",
    "return_difference", "return_difference_low", "return_difference_high", "return_p", "status", "command",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Changed:
    """A row in a setting against the same row unchanged."""

    result: Result
    usual: Result
    success: Contrast | None = None
    returns: Contrast | None = None
    p_holm: float | None = None
    refused: str | None = None


def against_unchanged(table: TableTitle, results: Sequence[Result]) -> list[Changed]:
    """Every row of a table of settings, p-values of success corrected over all of them."""
    named = {result.name: result for result in results}
    found = []
    for result in results:
        if result.row.table == table.name:
            found.append(_compared(result, _of_the_same_seeds(named[result.row.base], [result])))
    corrected = holm([one.success.p if one.success else None for one in found])
    return [replace(one, p_holm=p) for one, p in zip(found, corrected, strict=True)]


def unchanged_rows(table: TableTitle, results: Sequence[Result]) -> dict[str, Result]:
    """The rows of a table of settings in the unchanged world, of every training seed that a setting was played with."""
    played: dict[str, list[Result]] = {}
    for result in results:
        if result.row.table == table.name:
            played.setdefault(result.row.base, []).append(result)
    named = {result.name: result for result in results}
    return {name: _of_the_same_seeds(named[name], played[name]) for name in table.rows if name in played}


def settings_table(table: TableTitle, results: Sequence[Result]) -> Document:
    """Settings in lines and methods in columns for people; a line for each number for programs."""
    found = against_unchanged(table, results)
    usual = unchanged_rows(table, results)
    names, shared = short_labels([result.row for result in usual.values()])
    settings = list(dict.fromkeys(world(one.result.row.changes) for one in found))
    cells = {(world(one.result.row.changes), one.usual.name): one for one in found}
    rows = [(UNCHANGED, *(_usual_cell(result) for result in usual.values()))]
    lines = [tuple(cells.get((text, name)) for name in usual) for text in settings]
    rows += [(text, *map(_cell, line)) for text, line in zip(settings, lines, strict=True)]
    keys = [tuple(usual), *(tuple(one.result.name if one else "" for one in line) for line in lines)]
    measured = [one for one in found if one.success]
    tests = ", ".join(dict.fromkeys(one.success.test for one in measured))
    star = f"A star: p below {ALPHA} ({tests}; Holm over {len(measured)} comparisons). " if measured else ""
    notes = [
        "Successes of so many episodes; in parentheses the difference from the first line in percentage points, from "
        f"the same starts; last the average return. {star}A dash: the setting is in no line for this row.",
        f"All methods: {shared}." if shared else "",
        "Settings with fewer episodes than the first line are compared with the same training seeds there."
        if any(len(one.usual.evaluated) < len(usual[one.usual.name].evaluated) for one in measured)
        else "",
        *(
            _sentence(names[usual[name].row.label], [one for one in measured if one.usual.name == name])
            for name in (usual if len(settings) > 1 else ())  # one setting says itself
        ),
        *_side_by_side(names, found),
        *_events([one.result for one in found]),
        *(f"{one.result.name}: refused, because {one.refused}." for one in found if one.refused),
    ]
    is_missing = any(one.result.is_missing or one.usual.is_missing for one in found)
    commands = ((table.name, f"python -m imfvla.train -m +sweep={table.sweep}"),) if is_missing else ()
    columns = ("Setting", *(names[result.row.label] for result in usual.values()))
    notes = tuple(note for note in notes if note)
    shown = Table(table.title, columns, tuple(rows), notes, commands=commands, cell_keys=tuple(keys))
    data = [_data(Changed(result, result)) for result in usual.values()] + [_data(one) for one in found]
    return Document(shown, Table(table.title, COLUMNS, tuple(data)))


def _of_the_same_seeds(usual: Result, results: Sequence[Result]) -> Result:
    """The unchanged row of the training seeds that were played in the settings: other weights are no pairs of these."""
    seeds = {found.evaluation.training_seed for result in results for found in result.evaluated}
    kept = [found for found in usual.evaluated if found.evaluation.training_seed in seeds]
    return Result(kept, usual.answer) if kept else usual


def _compared(result: Result, usual: Result) -> Changed:
    if result.is_missing or usual.is_missing:
        return Changed(result, usual)
    reason = refusal(result.evaluated, usual.evaluated)
    if reason:
        return Changed(result, usual, refused=reason)
    pairs = Pairs(result.evaluated, usual.evaluated)
    return Changed(result, usual, success_difference(pairs), return_difference(pairs))


def _usual_cell(result: Result) -> str:
    return MISSING if result.is_missing else f"{_count(result)}, {_returned(result)}"


def _cell(one: Changed | None) -> str:
    if one is None:
        return "-"
    if one.result.is_missing or one.refused:
        return REFUSED if one.refused else MISSING
    if one.success is None:
        return f"{_count(one.result)}, {_returned(one.result)}"
    star = "*" if one.p_holm is not None and one.p_holm < ALPHA else ""
    change = f"({100 * one.success.result.value:+.0f}{star})"
    return f"{_count(one.result)} {change}, {_returned(one.result)}"


def _count(result: Result) -> str:
    return f"{sum(row['success'] for row in result.episodes)}/{len(result.episodes)}"


def _returned(result: Result) -> str:
    return f"{result.metric('avg_return').value:.0f}"


def _sentence(method: str, measured: Sequence[Changed]) -> str:
    """What was found of one method, whichever way it goes; nothing where it was not measured."""
    if not measured:
        return ""
    worst = min(measured, key=lambda one: one.success.result.value)
    percent = worst.success.result.scaled(100)
    lost = [
        one
        for one in measured
        if one.p_holm is not None and one.p_holm < ALPHA and one.success.result.value < 0
    ]
    told = (
        f"fewer successes than in the first line in {len(lost)} of {len(measured)} settings"
        if lost
        else f"no setting of {len(measured)} in which fewer successes are told from chance"
    )
    return (
        f"{method}: {told}; the lowest is {world(worst.result.row.changes)} with {percent.value:+.0f} points "
        f"{interval(percent, 0)}."
    )


def _side_by_side(names: Mapping[str, str], found: Sequence[Changed]) -> list[str]:
    """What is said of methods of which a worker plays several episodes at a time."""
    sizes: dict[str, list[int]] = {}
    for one in found:
        sizes.setdefault(one.usual.row.label, []).append(dict(one.result.row.changes).get("batch", 1))
    return [
        f"{names[method]}: {max(of_method)} episodes side by side in {sum(size > 1 for size in of_method)} of "
        f"{len(of_method)} settings, which changes the rounding of a chunk alone."
        for method, of_method in sizes.items()
        if max(of_method) > 1
    ]


def _events(results: Sequence[Result]) -> list[str]:
    """In how many episodes the event of each setting came, of all rows; in one sentence where it came in all."""
    counts: dict[str, tuple[int, int]] = {}
    for result in results:
        if _has_event(result):
            text = world(result.row.changes)
            pair = zip(counts.get(text, (0, 0)), condition_happened(result.episodes), strict=True)
            counts[text] = tuple(map(sum, pair))
    always = [text for text, (came, every) in counts.items() if came == every]
    return [f"The event came in every episode of: {'; '.join(always)}."] * bool(always) + [
        f"{text}: the event came in {came} of {every} episodes of all rows."
        for text, (came, every) in counts.items()
        if came < every
    ]


def _has_event(result: Result) -> bool:
    return not result.is_missing and any("condition_happened" in row for row in result.episodes)


def _data(one: Changed) -> tuple[str, ...]:
    result, row = one.result, one.result.row
    summaries = [found.evaluation.summary for found in result.evaluated]
    alone = [summary["latency_alone"]["median_ms"] for summary in summaries if "latency_alone" in summary]
    none = Contrast(Measured(None), None, "", None)
    success, returns = one.success or none, one.returns or none
    numbers = [measured for name in METRICS for measured in _of(result.metric(name))]
    numbers += [
        max((summary["protocol"]["delay_steps"] for summary in summaries), default=None),
        max(alone, default=None),
        condition_happened(result.episodes)[0] if _has_event(result) else None,
        *_of(success.result), success.p, one.p_holm, *_of(returns.result), returns.p,
    ]  # fmt: skip
    return (
        one.usual.name,
        label(row.changes) or UNCHANGED,
        str(row.nfe),
        str(len(result.episodes)),
        "" if result.is_missing else str(sum(episode["success"] for episode in result.episodes)),
        *("" if value is None else f"{value:.6g}" for value in numbers),
        MISSING if result.is_missing else REFUSED if one.refused else "measured",
        result.answer.command if result.is_missing else "",
    )


def _of(measured: Measured) -> tuple[float | None, ...]:
    return measured.value, measured.low, measured.high
