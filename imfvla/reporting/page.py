"""One static page: tables, figures, and for every row the runs, files and episodes behind it."""

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.metrics import Row
from imfvla.reporting.results import Result
from imfvla.reporting.table import FILL, Table
from imfvla.reporting.table_row import machine

TITLE = "iMF-AttnRes: tables and figures"
RUN_FILES = ("config.yaml", "metrics.jsonl", "made_by.json", "train.log")
EVALUATION_FILES = ("episodes.jsonl", "summary.json")
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 84rem; margin: 0 auto; padding: 1rem 1.2rem; }
h1 { font-size: 1.6rem; margin: 0.6rem 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 0.6rem; }
a { color: #0072b2; }
nav a { margin-right: 1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.6rem; text-align: left; white-space: nowrap; border-bottom: 1px solid #e8e8e8; }
th { border-bottom: 2px solid #8a8a8a; vertical-align: bottom; }
.number { text-align: right; }
.paper td { color: #6a6a6a; }
.missing td { background: #fff6e5; }
details:target { background: #e6f2fa; }
.note { color: #555; max-width: 60rem; }
code { font-size: 0.85em; background: #f4f4f4; padding: 0 0.2em; overflow-wrap: anywhere; }
figure { margin: 1.2rem 0 2rem; }
figure img { max-width: 100%; height: auto; }
figcaption { color: #555; }
details { border: 1px solid #e0e0e0; border-radius: 6px; padding: 0.4rem 0.8rem; margin: 0.4rem 0; }
summary { cursor: pointer; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.1rem 1rem; margin: 0.6rem 0; }
dt { color: #555; }
dd { margin: 0; overflow-wrap: anywhere; }
"""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the page: a short name, what it shows, and its SVG."""

    name: str
    caption: str
    svg: bytes


def page(
    tables: Sequence[Table], pictures: Sequence[Picture], results: Sequence[Result], directory: Path
) -> str:
    """The page as it lies in `directory`, from where links lead to the files of the runs. Needs no other file."""
    names = {result.name for result in results}
    sections = [
        *(
            f'<h2 id="{_id(table.title)}">{escape(table.title)}</h2>{_table(table, names)}'
            for table in tables
        ),
        '<h2 id="figures">Figures</h2>',
        *(_figure(picture) for picture in pictures),
        '<h2 id="rows">Rows, their runs and episodes</h2>',
        *(_row(result, directory) for result in results),
    ]
    links = [(table.title, _id(table.title)) for table in tables]
    links += [("Figures", "figures"), ("Rows", "rows")]
    navigation = "".join(f'<a href="#{target}">{escape(name)}</a>' for name, target in links)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{TITLE}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}</style></head>\n<body><h1>{TITLE}</h1>\n<nav>{navigation}</nav>\n"
        + "\n".join(sections)
        + "\n</body></html>\n"
    )


def _table(table: Table, names: set[str]) -> str:
    numeric = [table.is_numeric(name) for name in table.columns]
    heads = "".join(
        f"<th{_class(n)}>{escape(name)}</th>" for name, n in zip(table.columns, numeric, strict=True)
    )
    lines = []
    for number, row in enumerate(table.rows):
        keys = table.keys[number] if table.keys else ()
        cells = [escape(cell) for cell in row]
        if len(keys) == 1 and keys[0] in names:
            cells[0] = f'<a href="#{_anchor(keys[0])}">{cells[0]}</a>'
        elif len(keys) > 1:
            cells[0] += "".join(f' <a href="#{_anchor(key)}">{escape(key)}</a>' for key in keys)
        kind = "paper" if "paper" in row else "missing" if "missing" in row else ""
        filled = "".join(f"<td{_class(n)}>{cell}</td>" for cell, n in zip(cells, numeric, strict=True))
        lines.append(f'<tr class="{kind}">{filled}</tr>' if kind else f"<tr>{filled}</tr>")
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in table.notes)
    body = f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
    return f"{body}{notes}{_commands(table)}"


def _commands(table: Table) -> str:
    if not table.commands:
        return ""
    items = "".join(
        f"<li>{escape(', '.join(names))}:<br><code>{escape(command)}</code></li>"
        for command, names in table.by_command().items()
    )
    return f"<details><summary>{FILL}</summary><ul>{items}</ul></details>"


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.svg).decode()
    caption = escape(picture.caption)
    return (
        f'<figure id="{picture.name}"><img alt="{caption}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _row(result: Result, directory: Path) -> str:
    title = f"{result.row.label}, nfe {result.nfe}" if result.row else result.name
    if result.is_missing:
        content = f"<p>Missing. {FILL}<br><code>{escape(result.answer.command)}</code></p>"
        title += ": missing"
    else:
        content = "".join(_evaluated(found, directory) for found in result.evaluated)
    return f'<details id="{_anchor(result.name)}"><summary>{escape(title)}</summary>{content}</details>'


def _evaluated(found: Evaluated, directory: Path) -> str:
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
    links = [_link(evaluation.run, directory), *_links(evaluation.run, RUN_FILES, directory)]
    links += [_link(evaluation.folder, directory), *_links(evaluation.folder, EVALUATION_FILES, directory)]
    recordings = sorted(path.name for path in evaluation.folder.glob("*") if path.suffix in (".mcap", ".mp4"))
    links += _links(evaluation.folder, recordings, directory)
    described = "".join(f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in facts.items())
    return f"<dl>{described}<dt>files</dt><dd>{' · '.join(links)}</dd></dl>{_episodes(found.episodes)}"


def _episodes(episodes: Sequence[Row]) -> str:
    names = (
        "seed",
        "start",
        "return",
        "highest reward",
        "success-like",
        "first step of each stage",
        "failure",
    )
    heads = "".join(f'<th class="number">{name}</th>' for name in names)
    lines = []
    for row in episodes:
        cells = (
            row["seed"],
            row["start_digest"],
            f"{row['total_reward']:g}",
            f"{row['max_reward']:g}",
            "yes" if row["success"] else "no",
            " ".join("-" if step < 0 else str(step) for step in row["first_step_of_stage"]),
            row["failure"] or "-",
        )
        filled = "".join(f'<td class="number">{escape(str(cell))}</td>' for cell in cells)
        lines.append(f"<tr>{filled}</tr>")
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    return f'<details><summary>{len(episodes)} episodes</summary><div class="scroll">{table}</div></details>'


def _links(folder: Path, names: Sequence[str], directory: Path) -> list[str]:
    return [_link(folder / name, directory, name) for name in names if (folder / name).exists()]


def _link(path: Path, directory: Path, name: str | None = None) -> str:
    target = quote(Path(os.path.relpath(path, directory)).as_posix())
    return f'<a href="{target}">{escape(name or path.as_posix())}</a>'


def _anchor(name: str) -> str:
    return "row-" + "".join(
        character if character.isalnum() or character in "_-" else "-" for character in name
    )


def _id(title: str) -> str:
    return title.partition(":")[0].lower().replace(" ", "-")


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""
