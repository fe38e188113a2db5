"""One static page: sortable tables, figures, differences of rows, and the runs and episodes behind each row."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.escaping import html_text
from imfvla.reporting.mapping.settings import label
from imfvla.reporting.media import Media
from imfvla.reporting.notes import VERSUS
from imfvla.reporting.page_rows import anchor, differences_of, rollouts_of
from imfvla.reporting.records import Row
from imfvla.reporting.results import Result
from imfvla.reporting.table import FILL, Table
from imfvla.reporting.table_row import machine

TITLE = "iMF-AttnRes: tables and figures"
RUN_FILES = ("config.yaml", "metrics.jsonl", "made_by.json", "train.log")
EVALUATION_FILES = ("episodes.jsonl", "summary.json")
STYLE, SCRIPT = (Path(__file__).with_suffix(suffix) for suffix in (".css", ".js"))
ROLLOUTS = "Rollouts"
STAGES = "first step of each stage"


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the page: a short name, what it shows, and its SVG."""

    name: str
    caption: str
    svg: bytes


def page(
    tables: Sequence[Table], pictures: Sequence[Picture], results: Sequence[Result], media: Media
) -> str:
    """The page, which needs no files but those that `media` links to."""
    named = {result.name: result for result in results}
    sections = [
        *(
            f'<h2 id="{_id(table.title)}">{html_text(table.title)}</h2>{_table(table, named, media)}'
            for table in tables
        ),
        '<h2 id="figures">Figures</h2>',
        *(_figure(picture) for picture in pictures),
        '<h2 id="differ">What two rows differ in</h2>',
        differences_of(results),
        '<h2 id="rows">Rows, their runs and episodes</h2>',
        *(_row(result, media) for result in results),
    ]
    links = [(table.title, _id(table.title)) for table in tables]
    links += [("Figures", "figures"), ("Differences", "differ"), ("Rows", "rows")]
    navigation = "".join(f'<a href="#{target}">{html_text(name)}</a>' for name, target in links)
    head = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{TITLE}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<link rel="icon" href="data:,">\n'
        f"<style>\n{STYLE.read_text(encoding='utf-8')}</style></head>\n<body><h1>{TITLE}</h1>\n<nav>{navigation}</nav>"
    )
    tail = f"<script>\n{SCRIPT.read_text(encoding='utf-8')}</script></body></html>\n"
    return "\n".join((head, *sections, tail))  # once: it may have 100 MB


def _table(table: Table, named: Mapping[str, Result], media: Media) -> str:
    numeric = [table.is_numeric(name) for name in table.columns]
    every_keys = table.keys or ((),) * len(table.rows)
    shown = [rollouts_of(named[keys[0]], media) if len(keys) == 1 else "" for keys in every_keys]
    heads = [
        f'<th{_class(n)} aria-sort="none"><button type="button">{html_text(name)}</button></th>'
        for name, n in zip(table.columns, numeric, strict=True)
    ]
    heads[1:1] = [f'<th aria-sort="none"><button type="button">{ROLLOUTS}</button></th>'] * any(shown)
    lines = []
    for row, keys, rollouts in zip(table.rows, every_keys, shown, strict=True):
        cells = [_cell(cell, n) for cell, n in zip(row, numeric, strict=True)]
        if len(keys) == 1 and keys[0] in named:
            cells[0] = f'<a href="#{_anchor(keys[0])}">{cells[0]}</a>'
        elif len(keys) > 1:
            row_and_baseline = zip(keys, cells[0].split(VERSUS, 1), strict=False)
            cells[0] = VERSUS.join(f'<a href="#{_anchor(key)}">{name}</a>' for key, name in row_and_baseline)
        if table.cell_keys:
            linked = zip(cells[1:], table.cell_keys[len(lines)], strict=True)
            cells[1:] = [_linked(cell, named.get(key)) for cell, key in linked]
        kind = "paper" if "paper" in row else "missing" if "missing" in row else ""
        filled = [f"<td{_class(n)}>{cell}</td>" for cell, n in zip(cells, numeric, strict=True)]
        filled[1:1] = [f"<td>{rollouts}</td>"] * any(shown)
        lines.append(f'<tr class="{kind}">{"".join(filled)}</tr>' if kind else f"<tr>{''.join(filled)}</tr>")
    notes = "".join(f'<p class="note">{html_text(note)}</p>' for note in table.notes)
    body = f"<thead><tr>{''.join(heads)}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<div class="scroll"><table class="sortable">{body}</table></div>{notes}{_commands(table)}'


def _linked(cell: str, result: Result | None) -> str:
    """A cell that leads to its result, if that is measured."""
    if result is None or result.is_missing:
        return cell
    return f'<a href="#{_anchor(result.name)}">{cell}</a>'


def _cell(text: str, is_number: bool) -> str:
    """A number with its interval below it, whose ends may stand below each other where there is little room."""
    value, bracket, interval = text.partition(" [")
    if not (is_number and bracket):
        return html_text(text)
    return f'{html_text(value)} <span class="interval">[{html_text(interval)}</span>'


def _commands(table: Table) -> str:
    if not table.commands:
        return ""
    items = "".join(
        f"<li>{html_text(', '.join(names))}:<br><code>{html_text(command)}</code></li>"
        for command, names in table.by_command().items()
    )
    return f"<details><summary>{FILL}</summary><ul>{items}</ul></details>"


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.svg).decode()
    caption = html_text(picture.caption)
    return (
        f'<figure id="{html_text(picture.name)}"><img alt="{caption}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _row(result: Result, media: Media) -> str:
    title = f"{result.row.label}, nfe {result.nfe}" if result.row else result.name
    is_setting = bool(result.row and result.row.changes)
    if is_setting:
        title += f", {label(result.row.changes)}"
    if result.is_missing:
        content = f"<p>Missing. {FILL}<br><code>{html_text(result.answer.command)}</code></p>"
        title += ": missing"
    else:
        content = "".join(_evaluated(found, media) for found in result.evaluated)
        if is_setting:  # other rows have theirs in a table
            content = rollouts_of(result, media) + content
    return f'<details id="{_anchor(result.name)}"><summary>{html_text(title)}</summary>{content}</details>'


def _evaluated(found: Evaluated, media: Media) -> str:
    evaluation, summary = found.evaluation, found.evaluation.summary
    code = summary["fingerprint"].get("code", {})
    commit = f"{code.get('commit') or 'unknown'}{', with changes' if code.get('dirty') else ''}"
    facts = {
        "experiment": evaluation.label,
        "training seed": str(evaluation.training_seed),
        "weights": f"step {summary['checkpoint_step']} of {evaluation.training_steps}",
        "evaluated at commit": commit,
        "machine": machine(summary),
        "protocol": ", ".join(f"{key} {value}" for key, value in summary["protocol"].items()),
    }
    folders = [evaluation.run, *(evaluation.run / name for name in RUN_FILES)]
    folders += [evaluation.folder, *(evaluation.folder / name for name in EVALUATION_FILES)]
    recordings = sorted(path for path in evaluation.folder.glob("*") if path.suffix in (".mcap", ".mp4"))
    links = [anchor(path, evaluation.run, media) for path in (*folders, *recordings) if path.exists()]
    described = "".join(f"<dt>{name}</dt><dd>{html_text(text)}</dd>" for name, text in facts.items())
    return f"<dl>{described}<dt>files</dt><dd>{' · '.join(links)}</dd></dl>{_episodes(found.episodes)}"


def _episodes(episodes: Sequence[Row]) -> str:
    names = (
        "seed",
        "start",
        "return",
        "highest reward",
        "success-like",
        STAGES,
        "failure",
    )
    has_stages = any(row["first_step_of_stage"] for row in episodes)
    heads = "".join(f"<th>{name}</th>" for name in names if has_stages or name != STAGES)
    lines = "".join(  # a report may have hundreds of thousands of them
        f"<tr><td>{row['seed']}</td><td>{html_text(row['start_digest'])}</td><td>{row['total_reward']:g}</td>"
        f"<td>{row['max_reward']:g}</td><td>{'yes' if row['success'] else 'no'}</td>"
        f"{_stages(row) if has_stages else ''}<td>{html_text(row['failure']) if row['failure'] else '-'}</td></tr>"
        for row in episodes
    )
    table = f'<table class="episodes"><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table>'
    return f'<details><summary>{len(episodes)} episodes</summary><div class="scroll">{table}</div></details>'


def _stages(row: Row) -> str:
    return f"<td>{' '.join('-' if step < 0 else str(step) for step in row['first_step_of_stage'])}</td>"


def _anchor(name: str) -> str:
    return "row-" + "".join(
        character if character.isalnum() or character in "_-" else "-" for character in name
    )


def _id(title: str) -> str:
    return html_text(title.partition(":")[0].lower().replace(" ", "-"))


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""
