"""The page's parts about single rows: rollouts as videos, links to files, and the configs behind them."""

import json
from collections.abc import Sequence
from pathlib import Path

from imfvla.reporting.answers import Evaluated
from imfvla.reporting.escaping import html_json, html_text
from imfvla.reporting.media import Media
from imfvla.reporting.results import Result
from imfvla.storage.run_directory import flatten


def rollouts_of(result: Result, media: Media) -> str:
    """The recorded episodes of a row, folded, with their MCAP files; "" where there is no video."""
    figures = [figure for found in result.evaluated for figure in _videos(found, media)]
    if not figures:
        return ""
    return (
        f'<details class="rollouts"><summary>{len(figures)} videos</summary>'
        f'<div class="videos">{"".join(figures)}</div></details>'
    )


def anchor(path: Path, run: Path, media: Media) -> str:
    """A link to a file under its own name, or to a directory under its path; the path alone where nothing is linked."""
    text = html_text(path.as_posix() if path.is_dir() else path.name)
    address = media.link(path, run)
    return text if address is None else f'<a href="{address}">{text}</a>'


def differences_of(results: Sequence[Result]) -> str:
    """Two rows to choose, and the keys in which their configs and evaluations differ."""
    configs = {result.name: _config(result) for result in results if not result.is_missing}
    options = "".join(f'<option value="{html_text(name)}">{html_text(name)}</option>' for name in configs)
    choices = "".join(
        f'<label>{"Row" if name == "one" else "against row"} <select id="differ-{name}">{options}</select></label>'
        for name in ("one", "other")
    )
    return (
        f'<script type="application/json" id="configs">{html_json(configs)}</script><p class="choice">{choices}</p>'
        '<div class="scroll"><table id="differences"><thead><tr><th>Key</th><th>Row</th><th>Against</th></tr></thead>'
        '<tbody></tbody></table></div><p id="no-difference" class="note" hidden>Nothing.</p>'
        '<noscript><p class="note">This needs JavaScript; config.yaml of each run is linked below.</p></noscript>'
    )


def _videos(found: Evaluated, media: Media) -> list[str]:
    folder, figures = found.evaluation.folder, []
    for label, recording in found.evaluation.summary.get("recordings", {}).items():
        mcap = folder / recording["file"]
        video = media.link(mcap.with_suffix(".mp4"), found.evaluation.run)
        if video is None:
            continue
        caption = f"{label}: seed {recording['seed']}, return {recording['return']:g}"
        link = f" · {anchor(mcap, found.evaluation.run, media)}" if mcap.exists() else ""
        figures.append(
            f'<figure><video controls muted playsinline preload="none" src="{video}"></video>'
            f"<figcaption>{html_text(caption)}{link}</figcaption></figure>"
        )
    return figures


def _config(result: Result) -> dict[str, str]:
    """Key to value as text, of the first of several training seeds."""
    evaluation = result.first
    values = flatten(evaluation.config) | {
        f"evaluated: {key}": value for key, value in evaluation.summary["protocol"].items()
    }
    return {key: json.dumps(value) for key, value in values.items()}
