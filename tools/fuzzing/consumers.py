"""What works with files that somebody else may have written, from the file to what is printed or drawn.

Each consumer has a small whole run of its own, which is restored before every file: some of them write into it.
"""

import json
import shutil
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from fakes import FakeEnvironment, build_fakes
from mcap_check import check
from mcap_to_mp4 import export
from synthetic import write_episode
from synthetic_runs import answer_row, make_run, write_evaluation
from tiny_policy import OPTIM, OPTIONS, CountedBatches, TinyPolicy

from fuzzing.mutations import mutate_json, mutate_recording, mutate_safetensors, mutate_yaml
from fuzzing.readers import Target
from imfvla.config.protocol import CONTINUE, MEASURED, RUNNING, EvaluationOptions
from imfvla.data import ResumableSampler
from imfvla.errors import UserError
from imfvla.figures.depth_attention import depth_attention, read_depth_attention
from imfvla.figures.evaluations import success_by_evaluations
from imfvla.figures.failures import failed_stages
from imfvla.figures.learning import learning_curves
from imfvla.figures.settings import success_by_delay, success_by_severity
from imfvla.figures.style import style
from imfvla.figures.two_runs import two_runs
from imfvla.reporting.answers import Sources
from imfvla.reporting.curves import learning_curve
from imfvla.reporting.mapping import TableRow, read_mapping
from imfvla.reporting.mapping.settings import rows_of_settings
from imfvla.reporting.media import Media
from imfvla.reporting.offline import read_offline
from imfvla.reporting.offline_tables import by_channel, by_step, offline_table
from imfvla.reporting.page import page
from imfvla.reporting.recomputed import DESCRIPTION, description_digest
from imfvla.reporting.results import Result
from imfvla.reporting.settings_table import settings_table
from imfvla.reporting.table_row import print_row
from imfvla.reporting.tables import other_table
from imfvla.reporting.two_runs import compare_runs, table_of, verdict
from imfvla.rollouts.evaluation import evaluate
from imfvla.rollouts.rollout_log import PARTIAL
from imfvla.storage.files import write_json
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import save_weights
from imfvla.training.loop import Trainer
from imfvla.training.options import TrainingOptions

DRAWN = 20  # one of so many files is drawn too, which takes a hundred times longer
EVALUATION = EvaluationOptions(episodes=3, first_seed=100_000, nfe=(1,), workers=0, recordings=False)
SETTINGS, SETTINGS_OF = "table4", "transfer_imf_infer1"
Consumer = Callable[[], Any]


class SampledBatches(CountedBatches):
    """The tiny policy's batches, with the state of those of a real training."""

    def __init__(self) -> None:
        super().__init__()
        self._sampler = ResumableSampler(100, 8, 0)

    def state_dict(self) -> dict[str, Any]:
        return self._sampler.state_dict() | {"next_batch": self.next_batch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._sampler.load_state_dict(state)
        self.next_batch = self._sampler.next_batch


def make_consumers(folder: Path) -> dict[str, Target]:
    """The consumers by name, each with the file that is damaged, below `folder`."""
    reported = RunDirectory(
        make_run(folder / "report" / "x" / "default", "x", core={"_target_": "imfvla.nn.X"})
    )
    rollouts = write_evaluation(reported.path, 1, number=3, quality=0.5)
    write_evaluation(reported.path, 10, number=3, quality=0.7, stages=["a", "b", "c", "d", "e"])
    weights = {"actions": [[1.0], [0.5, 0.5], [0.2, 0.3, 0.5]], "context": []}
    write_json(reported.path / "depth_attention.json", {"experiment": "x", "checkpoint_step": 3, **weights})
    reported.write_status("done")
    other = RunDirectory(make_run(folder / "compared" / "default", "y"))
    write_evaluation(other.path, 1, number=3, quality=0.3, stream=1)
    evaluated, interrupted, resumed = (
        folder / name / "default" for name in ("evaluated", "interrupted", "resumed")
    )
    _write_evaluated(evaluated)
    finished = _rollouts_of(evaluated)
    shutil.copytree(evaluated, interrupted)
    _interrupt(interrupted)
    _write_resumed(resumed)
    offline = _write_offline(folder / "offline" / "default")
    recording = folder / "recordings" / "episode.mcap"
    write_episode(recording, 7, num_steps=5, views=("front", "top"), image_size=(16, 16))

    def report(path: Path) -> None:
        _report(reported, is_drawn=_is_drawn(path))

    def compare(path: Path) -> None:
        duels = compare_runs(reported, other)
        table, _ = table_of(duels), [verdict(duel) for duel in duels]
        table.markdown(), table.csv(), table.print()
        if _is_drawn(path):
            _draw(two_runs(duels))

    def in_settings(path: Path) -> None:
        _report_settings(folder / "settings", is_drawn=_is_drawn(path))

    def restored(home: Path, consume: Consumer) -> Callable[[Path], None]:
        return _restored(home, consume)

    settings = make_settings(folder / "settings")
    evaluate_again = restored(evaluated, lambda: _evaluate(evaluated))
    go_on = restored(interrupted, lambda: _evaluate(interrupted))
    resume = restored(resumed, lambda: _resume(resumed))
    consumers = {
        "report_summary": (rollouts / "summary.json", report, mutate_json),
        "report_episodes": (rollouts / "episodes.jsonl", report, mutate_json),
        "report_config": (reported.path / "config.yaml", report, mutate_yaml),
        "report_metrics": (reported.metrics, report, mutate_json),
        "report_depth_attention": (reported.path / "depth_attention.json", report, mutate_json),
        **{f"settings_{name}": (path, in_settings, mutate_json) for name, path in settings.items()},
        "report_offline": (offline, lambda path: _report_offline(RunDirectory(path.parent)), mutate_json),
        "compare_summary": (rollouts / "summary.json", compare, mutate_json),
        "compare_episodes": (rollouts / "episodes.jsonl", compare, mutate_json),
        "evaluate_config": (evaluated / "config.yaml", evaluate_again, mutate_yaml),
        "evaluate_summary": (finished / "summary.json", evaluate_again, mutate_json),
        "evaluate_partial": (_rollouts_of(interrupted) / PARTIAL, go_on, mutate_json),
        "resume_state": (RunDirectory(resumed).last_state, resume, mutate_safetensors),
        "resume_metrics": (RunDirectory(resumed).metrics, resume, mutate_json),
        "mcap_check": (recording, lambda path: check(path), mutate_recording),
        "mcap_to_mp4": (
            recording,
            lambda path: export(path, path.with_suffix(".mp4"), None),
            mutate_recording,
        ),
    }
    return {name: Target(*consumer) for name, consumer in consumers.items()}


def _is_drawn(path: Path) -> bool:
    return zlib.crc32(path.read_bytes()) % DRAWN == 0


def _draw(figure: Any) -> None:
    with style():
        figure.draw_without_rendering()


def _report(run: RunDirectory, *, is_drawn: bool) -> None:
    """The rows of the run, its tables and its part of the page, as `imfvla.report` makes them."""
    print_row(run)
    sources, mapping = Sources([run.path.parents[1]]), read_mapping()
    for row in mapping.rows[:1]:
        with suppress(UserError):
            sources.answer(row, mapping)
    results = [Result(found) for found in sources.others([])]
    table = other_table(results)
    table.shown.markdown(), table.data.csv(), table.shown.latex(), table.shown.print()
    page([table.shown], [], results, Media(run.path.parent, is_copied=False))
    config = sources.configs[run.path]
    weights = read_depth_attention(run.path, config.get("core"))
    learning_curve(run.path)
    if is_drawn:
        for figure in (learning_curves(results), success_by_evaluations(results), failed_stages(results)):
            _draw(figure)
        _draw(depth_attention([weights]))


def make_settings(folder: Path) -> dict[str, Path]:
    """A row of the tables in the unchanged world, on a running clock with a measured delay, and with a bump."""
    row, *changed = _rows_of_settings()
    answer_row(folder, row)
    latency = {
        "median_ms": 120.0,
        "p95_ms": 130.0,
        "calls": 20,
        "at": "2026-11-28T00:00:00+00:00",
        "load": 1.0,
    }
    found = {}
    for name, other in zip(("running", "bump"), changed, strict=True):
        path = answer_row(folder, other, quality=0.3, **dict(other.changes)) / "summary.json"
        summary = json.loads(path.read_text(encoding="utf-8"))
        if name == "running":
            summary["protocol"]["delay_steps"] = 6
            summary["latency_alone"] = {**latency, "nfe": summary["nfe"]}
        write_json(path, summary | {DESCRIPTION: description_digest(summary)} if name == "bump" else summary)
        found[name] = path
    return found


def _rows_of_settings() -> list[TableRow]:
    """Of three episodes, so that they are read quickly."""
    mapping = read_mapping()
    base = next(row for row in mapping.rows if row.name == SETTINGS_OF)
    entries = [
        {"clock": RUNNING, "delay_ms": MEASURED, "meanwhile": CONTINUE},
        {"condition": "bump", "severity": 2},
    ]
    rows = [base, *rows_of_settings(entries, SETTINGS, [base.name], {base.name: base}, Path("tables.yaml"))]
    return [replace(row, wanted=replace(row.wanted, episodes=3)) for row in rows]


def _report_settings(folder: Path, *, is_drawn: bool) -> None:
    mapping, sources = read_mapping(), Sources([folder])
    results = [Result.of(sources.answer(row, mapping)) for row in _rows_of_settings()]
    document = settings_table(replace(mapping.table(SETTINGS), rows=(SETTINGS_OF,)), results)
    document.shown.markdown(), document.data.csv(), document.shown.latex(), document.shown.print()
    if is_drawn:
        for draw in (success_by_delay, success_by_severity):
            _draw(draw(results))


def _report_offline(run: RunDirectory) -> None:
    found = read_offline(run)
    by_channel(found).markdown(), by_step(found).markdown()
    offline_table([("x", found)]).shown.markdown()


def _evaluate(run: Path) -> None:
    """What is left of an evaluation, and its row."""
    evaluate(RunDirectory(run), EVALUATION, build=build_fakes)
    print_row(RunDirectory(run))


def _resume(run: Path) -> None:
    """The last step of the training."""
    _trainer(run, OPTIONS).train()


def _restored(home: Path, consume: Consumer) -> Callable[[Path], None]:
    """`consume` after which the directory is as it is now, but for the file that is given."""
    whole = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}

    def read(damaged: Path) -> None:
        try:
            consume()
        finally:
            content = damaged.read_bytes() if damaged.exists() else whole[damaged]
            shutil.rmtree(home)
            for path, data in whole.items():
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content if path == damaged else data)

    return read


def _rollouts_of(run: Path) -> Path:
    return next((run / "rollouts").iterdir())


def _write_evaluated(run: Path) -> None:
    """A run with a finished evaluation by the tests' fakes."""
    weights = RunDirectory(run).weights_directory(4)
    save_weights(weights, TinyPolicy(), {"step": 4})
    config = {
        "name": "fake",
        "seed": 0,
        "training": {"steps": 4},
        "task": {"name": "fake", "variant": "default"},
        "observation": {"views": ["front"], "image_size": [16, 16]},
    }
    (run / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    evaluate(RunDirectory(run), EVALUATION, build=build_fakes)


class Stopped(Exception):
    """Ends an evaluation."""


class StoppingEnvironment(FakeEnvironment):
    """Stops at the last episode."""

    def reset(self, seed: int) -> None:
        if seed == EVALUATION.first_seed + EVALUATION.episodes - 1:
            raise Stopped
        super().reset(seed)


def _interrupt(run: Path) -> None:
    """Turns a finished evaluation into one that stopped before its last episode."""
    shutil.rmtree(run / "rollouts")

    def build(run: Path, step: int) -> Any:
        return StoppingEnvironment(), build_fakes(run, step)[1]

    with suppress(Stopped):
        evaluate(RunDirectory(run), EVALUATION, build=build)


def _write_resumed(run: Path) -> None:
    """A training that ends, and its state of a step before."""
    (run / "config.yaml").parent.mkdir(parents=True)
    (run / "config.yaml").write_text("name: x\n", encoding="utf-8")
    first = replace(OPTIONS, steps=OPTIONS.steps - 1, checkpoints=1)
    _trainer(run, first).train()


def _trainer(run: Path, options: TrainingOptions) -> Trainer:
    return Trainer(
        TinyPolicy(), SampledBatches(), RunDirectory(run), options, OPTIM, seed=0, description={"name": "x"}
    )


def _write_offline(run: Path) -> Path:
    errors = [[0.1, None], [0.2, 0.4]]
    write_json(
        run / "offline.json",
        {
            "experiment": "x",
            "protocol": {"checkpoint_step": 3, "held_out": [1, 2], "nfe": [1]},
            "decisions": 5,
            "executed": 1,
            "channels": ["a [rad]", "b [m]"],
            "deviation": [0.5, 0.0],
            "error": {"hold still": errors, "nearest demonstration": errors, "infer1": errors},
        },
    )
    return run / "offline.json"
