"""The README of a shipped policy: what it is, what it reaches and where it fails, how it was made, how to use it."""

import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from imfvla.options import part_of
from imfvla.reporting.answers import Evaluated
from imfvla.reporting.cells import BY_NAME, with_its_interval
from imfvla.reporting.escaping import markdown_cell, markdown_text
from imfvla.reporting.results import Result
from imfvla.reporting.rows import first_failed_stage
from imfvla.reporting.runs import Evaluation, evaluations
from imfvla.reporting.table import Table, number
from imfvla.storage.records import WeightsDescription, read_record
from imfvla.storage.run_directory import LAST, RunDirectory

NAME = "README.md"
OF_NOISE = {"noise", "noise_scale", "candidates"}  # keys of a protocol
LIMITS = (
    "It was trained and measured in simulation alone, with one robot, these cameras where they are, and scripted "
    "demonstrations. It knows no other scene, robot or sentence, and has no part that keeps a real robot safe."
)


def model_card(run: RunDirectory, place: Path, command: str) -> str:
    """Markdown about a policy with weights in `run`, made by `command`; commands that use it name `place`.

    Its results are its evaluations on the reporting band. Raises UserError where files are missing or damaged.
    """
    config = run.config()
    weights = read_record(
        run.policy_weights(LAST).with_suffix(".json"), WeightsDescription, "restore it or train again"
    )
    found = [evaluation for evaluation in evaluations(run, config) if evaluation.is_reporting]
    usual = _sorted(e for e in found if e.is_usual)
    other_noise = _sorted(e for e in found if e.changes and set(e.changes) <= OF_NOISE)
    left = len(found) - len(usual) - len(other_noise)
    sections = [
        f"# {markdown_text('/'.join(place.parts[-2:]))}",
        _facts(config, weights),
        "## Results",
        _results([*usual, *other_noise]),
        _failures(usual),
    ]
    if left:
        sections.append(
            f"Its {left} evaluations with a running clock or in a changed world are in `rollouts/`; `make tables` "
            "shows them."
        )
    sections += ["## Use", _use(place, command, usual), "## Limits", LIMITS]
    return "\n\n".join(section for section in sections if section) + "\n"


def _sorted(found: Iterable[Evaluation]) -> list[Evaluation]:
    return sorted(found, key=lambda e: (e.summary["checkpoint_step"], e.nfe))


def _facts(config: Mapping[str, Any], weights: WeightsDescription) -> str:
    made, horizon, batch = (
        weights["fingerprint"],
        part_of(config, "horizon"),
        part_of(config, "training")["batch_size"],
    )
    generator, core = (part_of(config, key)["_target_"].rpartition(".")[2] for key in ("generator", "core"))
    size = f", {weights['num_parameters'] / 1e6:.2f} M parameters" if "num_parameters" in weights else ""
    threads = f"{made['threads']} thread(s)" if "threads" in made else None
    spent = (
        f"{weights['train_s'] / 60:.0f} min",
        threads,
        weights.get("precision"),
        made["machine"].get("cpu"),
    )
    code = made.get("code", {})
    facts = {
        "policy": f"{generator} on {core}{size}",
        **_of_robot(config.get("robot")),
        "chunk": f"{horizon['pred']} steps, of which {horizon['exec']} are executed",
        **_of_task(part_of(config, "task"), part_of(config, "demos")),
        "training": f"{weights['step']} steps of {batch} observations, seed {config['seed']}",
        "its time": ", ".join(part for part in spent if part),
        "code": f"imfvla {code.get('version')}, commit {(code.get('commit') or 'unknown')[:7]}",
    }
    lines = [f"| {name} | {markdown_cell(text)} |" for name, text in facts.items()]
    return "\n".join(["| | |", "|---|---|", *lines])


def _of_robot(robot: Mapping[str, Any] | None) -> dict[str, str]:
    """Nothing for a run from before configs said it, which is of our two arms."""
    if robot is None:
        return {}
    cameras = (f"{camera['name']} {camera['height']} x {camera['width']}" for camera in robot["cameras"])
    channels = f"{len(robot['state'])} state and {len(robot['action'])} action channels"
    return {"robot": f"{channels}, {robot['control_hz']:g} Hz", "cameras": ", ".join(cameras)}


def _of_task(task: Mapping[str, Any], demos: Mapping[str, Any]) -> dict[str, str]:
    source = demos.get("source", "scripted")
    said = {key: demos[key] for key in ("episodes", "first_seed") if demos.get(key) is not None}
    said |= {f"expert.{key}": value for key, value in task.get("expert", {}).items()}
    variant = f" ({task['variant']})" if "variant" in task else ""
    shown = (f"{key} {value}" for key, value in said.items())
    return {"task": f"{task['name']}{variant}", "demonstrations": ", ".join((source, *shown))}


def _results(found: Sequence[Evaluation]) -> str:
    first = found[0]
    shown = ("success_episodes", "avg_return", "median_return")
    columns = ("Evaluations of the network", "Weights", *(BY_NAME[name].title for name in shown), "Chunk ms")
    rows = []
    for evaluation in found:
        result = Result([Evaluated(evaluation, evaluation.episodes)])
        cells = [with_its_interval(BY_NAME[name], result) for name in shown]
        ms = number(evaluation.summary["inference_ms_median"], 1)
        nfe = ", ".join((str(evaluation.nfe), *evaluation.unusual))
        rows.append((nfe, f"step {evaluation.summary['checkpoint_step']}", *cells, ms))
    table = Table("", columns, tuple(rows)).markdown().partition("\n\n")[2].strip()
    said = (
        f"{len(first.episodes)} episodes from seeds {first.seeds[0]} to {first.seeds[-1]}, never used for a choice. In "
        "brackets 95% intervals over episodes of this one training. The times of chunks are medians within these "
        "rollouts, on a machine that did other work too."
    )
    return f"{table}\n\n{said}"


def _failures(usual: Sequence[Evaluation]) -> str:
    """How often each stage was the first that failed, over all `usual` results of the last weights."""
    stages = usual[-1].summary.get("stages") or []
    rows = [row for e in usual if e.summary["checkpoint_step"] == e.training_steps for row in e.episodes]
    failed = [row for row in rows if not row["success"]]
    if not stages or not failed:
        return ""
    counts = Counter(first_failed_stage(row) for row in failed)
    del counts[None]  # all stages held, but not to the end
    told = ", ".join(f"{stages[stage]} {count}" for stage, count in sorted(counts.items()))
    of_all = f"Of the {len(rows)} episodes with full noise {len(failed)} failed"
    return f"{of_all}, by the first stage that they did not reach: {told}."


def _use(place: Path, command: str, usual: Sequence[Evaluation]) -> str:
    run, nfe = shlex.quote(f"run={place.as_posix()}"), min(evaluation.nfe for evaluation in usual)
    commands = (
        f"python -m imfvla.evaluate {run} nfe={nfe} episodes=4 first_seed=10000    # plays it, with videos",
        f"python -m imfvla.export {run} nfe={nfe} output=outputs/onnx    # for ONNX Runtime",
        f"{command}    # trained it, at the commit above",
    )
    return "\n".join(["```bash", *commands, "```"])
