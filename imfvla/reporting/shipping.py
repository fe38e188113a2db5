"""What is kept of a finished run: a policy that others can evaluate, or a result without its weights."""

import re
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.config.protocol import REPORTING_FIRST_SEED
from imfvla.errors import UserError
from imfvla.options import part_of
from imfvla.reporting.model_card import NAME as CARD
from imfvla.reporting.model_card import model_card
from imfvla.reporting.runs import evaluations
from imfvla.storage.documents import read_lines
from imfvla.storage.files import (
    clear_write_errors,
    copy_file,
    locked,
    put_folder,
    refuse_existing,
    write_json,
    write_text,
)
from imfvla.storage.metrics import MOST_PARTS
from imfvla.storage.records import WeightsDescription, read_record
from imfvla.storage.run_directory import DONE, LAST, RunDirectory, flatten

MAX_BYTES = 16_000_000  # of the weights
EXISTING = "remove it first"
THINNING = 10
TRAIN = ("python", "-m", "imfvla.train")
RECORDED = ("depth_attention.json",)  # what tools may have added to a run


def ship(run: RunDirectory, target: Path, with_weights: bool = True) -> dict[str, object]:
    """Makes `target`, which must not exist yet, whole or not at all, and returns the content of made_by.json.

    It gets config and status, the last averaged weights, the metrics of every 10th logged step, the episodes and
    summaries of the reporting band, the files that `RECORDED` names, and with weights a model card. Raises UserError
    for an unfinished run, weights above 16 MB, no reported evaluation, or a target that exists.
    """
    refuse_existing(target, EXISTING)
    state = run.status().get("state")
    if state != DONE:
        raise UserError(f"{run.path} is not a finished run: its state is {state}, wanted {DONE}.")
    weights = run.policy_weights(LAST)
    size = weights.stat().st_size
    if with_weights and size > MAX_BYTES:
        raise UserError(f"{weights} has {size} bytes: wanted at most {MAX_BYTES}; train a narrower core.")
    reported = [evaluation for evaluation in evaluations(run) if evaluation.is_reporting]
    if not reported:
        raise UserError(
            f"{run.path} has no evaluation of the reporting band: first_seed={REPORTING_FIRST_SEED}."
        )
    made_by = provenance(run, weights, [evaluation.summary for evaluation in reported])
    recorded = [run.path / name for name in RECORDED if (run.path / name).exists()]
    copied = [run.path / "config.yaml", run.path / "status.json", *recorded]
    copied += [weights.with_suffix(".json"), weights] if with_weights else []
    copied += [one.folder / name for one in reported for name in ("episodes.jsonl", "summary.json")]
    rows = read_lines(run.metrics, "restore it or train again", most_parts=MOST_PARTS)
    part = target.with_name(f".{target.name}.part")
    with locked(target):
        refuse_existing(target, EXISTING)
        shutil.rmtree(part, ignore_errors=True)
        try:
            for source in copied:
                copy_file(source, part / source.relative_to(run.path), home=run.path)
            write_text(part / "metrics.jsonl", "".join(rows[THINNING - 1 :: THINNING]))
            write_json(part / "made_by.json", made_by)
            if with_weights:
                write_text(part / CARD, model_card(run, target, str(made_by["command"])))
            with clear_write_errors(target):
                put_folder(part, target)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return made_by


def command_of(run: RunDirectory, config: Mapping[str, Any]) -> str:
    """The command that made a run: as it was recorded, which older runs were not.

    Theirs is read from the name of the directory and, where the name lost brackets, from the config.
    """
    recorded = run.overrides()
    if recorded is not None:
        return shlex.join([*TRAIN, *recorded])
    values = flatten(config)
    name = "" if run.path.name == "default" else run.path.name
    overrides = []
    for text in re.split(r",(?=[\w./@-]+=)", name) if name else []:
        key = text.partition("=")[0]
        value = values.get(key)
        overrides.append(f"{key}=[{','.join(map(str, value))}]" if isinstance(value, list) else text)
    return shlex.join([*TRAIN, f"+exp={part_of(config, 'name')}", *overrides])


def provenance(run: RunDirectory, weights: Path, summaries: list[dict]) -> dict[str, object]:
    """Command, commit, seed and results of a run."""
    config = run.config()
    made = read_record(weights.with_suffix(".json"), WeightsDescription, "restore it or train again")
    shown = ("success_episodes", "episodes", "avg_return", "median_return", "inference_ms_median")
    return {
        "command": command_of(run, config),
        "seed": part_of(config, "seed"),
        "code": made["fingerprint"].get("code"),
        "steps": made["step"],
        "train_s": made["train_s"],
        "machine": made["fingerprint"]["machine"],
        "results": {s["name"]: {key: s[key] for key in shown} for s in summaries},
    }
