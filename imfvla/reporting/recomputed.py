"""The numbers of an evaluation come from episodes.jsonl; those in summary.json are a copy that nothing relies on."""

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from math import isclose
from pathlib import Path
from typing import Any

from imfvla.config.protocol import MEASURED, PAUSED, USUAL
from imfvla.errors import UserError
from imfvla.reporting.episodes import REMEDY, episode_lines, parse_episodes
from imfvla.reporting.metrics import summarise
from imfvla.reporting.records import Row

EPISODES = "episodes.jsonl"
DIGEST = "episodes_digest"  # key of summary.json; evaluations from before it have none
DESCRIPTION = "description_digest"  # key of summary.json; evaluations from before it have none
DESCRIBED = (
    *("name", "experiment", "nfe", "checkpoint_step", "stages", "seeds", "protocol", "latency_alone"),
    "fingerprint",
)
RECORDINGS = "recordings"  # key of summary.json, with the returns of the episodes that were recorded
OF_LATENCY = ("weights", "nfe", "candidates", "prefix", "device", "runtime")
OF_RUNNING = ("delay_ms", "delay_steps", "meanwhile", "prefix")  # keys of a protocol
OF_SOME = ("success_of_goal", "condition_happened")  # metrics that not every evaluation has
log = logging.getLogger(__name__)


def recomputed(
    folder: Path, summary: Mapping[str, Any], *, home: Path | None = None
) -> tuple[dict[str, Any], tuple[Row, ...]]:
    """A summary with the numbers of the episodes beside it, and these in the order of their seeds.

    Files must lie in `home`, by default the folder itself.

    Raises UserError where they are missing, damaged or not those that the summary was made from, and where the summary
    contradicts its protocol.
    """
    _refuse_contradictions(folder, summary)
    first, last = summary["seeds"]
    lines = episode_lines(folder / EPISODES, home)
    rows = parse_episodes(lines, folder / EPISODES, range(first, last + 1))
    metrics = summarise(rows)
    wrong = [key for key, value in metrics.items() if key in summary and not _equal(summary[key], value)]
    if DIGEST in summary:
        if summary[DIGEST] != digest_of("".join(lines)):
            raise UserError(
                f"{folder / EPISODES} was changed after its summary.json was written, which has another {DIGEST}: "
                f"{REMEDY}."
            )
        if wrong:
            log.warning(
                "%s/summary.json was changed: its %s is not that of the episodes, whose numbers are used.",
                folder,
                ", ".join(wrong),
            )
    elif wrong:  # from before digests, so that nothing says which of the two was changed
        raise UserError(
            f"{folder / EPISODES} gives another {', '.join(wrong)} than its summary.json: one was changed; {REMEDY}."
        )
    rest = {key: value for key, value in summary.items() if key not in (*metrics, *OF_SOME)}
    if isinstance(recordings := summary.get(RECORDINGS), Mapping):
        rest[RECORDINGS] = _with_returns(folder, recordings, rows)
    return metrics | rest, rows


def digest_of(text: str) -> str:
    """16 hex digits of all rows, as the file has them."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


def description_digest(summary: Mapping[str, Any]) -> str:
    """16 hex digits of all in a summary that its episodes do not say, as its file has it."""
    said = {key: summary[key] for key in DESCRIBED if key in summary}
    return digest_of(json.dumps(said, sort_keys=True))


def _with_returns(folder: Path, recordings: Mapping[str, Any], rows: Sequence[Row]) -> dict[str, Any]:
    """The recorded episodes with the returns of their rows. Raises UserError where one has no row."""
    returns = {row["seed"]: row["total_reward"] for row in rows}
    for label, recording in recordings.items():
        if recording["seed"] not in returns:
            raise UserError(
                f"{folder}/summary.json: the recording {label} is of seed {recording['seed']}, which {EPISODES} lacks: "
                f"{REMEDY}."
            )
    return {
        label: {**recording, "return": returns[recording["seed"]]} for label, recording in recordings.items()
    }


def _refuse_contradictions(folder: Path, summary: Mapping[str, Any]) -> None:
    """Raises UserError where the description of an evaluation is not that of its protocol."""
    protocol = summary["protocol"]
    stated = {"nfe": summary["nfe"], "checkpoint_step": summary["checkpoint_step"]}
    stated |= {"first_seed": summary["seeds"][0], "episodes": summary["seeds"][1] - summary["seeds"][0] + 1}
    for key, value in stated.items():
        if protocol.get(key, value) != value:
            raise UserError(
                f"{folder}/summary.json states {key} {value!r}, but its protocol has {protocol[key]!r}: one was "
                f"changed; {REMEDY}."
            )
    if latency := summary.get("latency_alone"):
        for key in (key for key in OF_LATENCY if key in latency and latency[key] != protocol.get(key)):
            raise UserError(
                f"{folder}/summary.json has a latency of {key} {latency[key]!r}, but its protocol has "
                f"{protocol.get(key)!r}: one was changed; {REMEDY}."
            )
    elif protocol.get("delay_ms") == MEASURED:
        raise UserError(f"{folder}/summary.json has a measured delay, but lacks latency_alone: {REMEDY}.")
    paused = protocol.get("clock", PAUSED) == PAUSED
    if needless := [key for key in OF_RUNNING if paused and protocol.get(key, USUAL[key]) != USUAL[key]]:
        raise UserError(
            f"{folder}/summary.json has {needless[0]} {protocol[needless[0]]!r} on a paused clock: one was changed; "
            f"{REMEDY}."
        )
    condition, severity = (protocol.get(key, USUAL[key]) for key in ("condition", "severity"))
    if (condition == USUAL["condition"]) != (severity is None):
        raise UserError(
            f"{folder}/summary.json has the condition {condition} with severity {severity}: one was changed; {REMEDY}."
        )


def _equal(told: Any, value: Any) -> bool:
    if isinstance(value, list) and isinstance(told, list):
        return len(value) == len(told) and all(map(_equal, told, value))
    if isinstance(value, float) and isinstance(told, int | float):
        return isclose(told, value, rel_tol=1e-6)
    return told == value
