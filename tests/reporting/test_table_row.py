"""The row beside the paper's, from a finished run's files alone."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from imfvla.episode import EpisodeResult
from imfvla.errors import UserError
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.metrics import summarise
from imfvla.reporting.recomputed import digest_of
from imfvla.reporting.rows import row_of
from imfvla.reporting.runs import rows
from imfvla.reporting.table_row import print_row
from imfvla.storage.run_directory import RunDirectory

EXPECTED_FILE = Path(__file__).with_name("table_row.md")
EXPECTED = EXPECTED_FILE.read_text()


def write_evaluation(
    run: Path,
    nfe: int,
    *,
    first_seed: int = 100_000,
    step: int = 20,
    gain: float = 1.0,
    max_steps: int | None = None,
    failure: str | None = None,
) -> Path:
    episodes = [
        row_of(
            EpisodeResult(
                seed=first_seed + index, start_digest=f"{index:016x}", num_steps=700,
                total_reward=gain * (1200.0 + 200 * index), max_reward=3.0 + 2 * (index % 2),
                success=index % 2 == 1, first_step_of_stage=(), failure=failure,
                inference_ms=(4.0, 8.0), wall_s=2.0,
            )
        )
        for index in range(4)
    ]  # fmt: skip
    summary = summarise(episodes) | {
        "experiment": yaml.safe_load((run / "config.yaml").read_text())["name"],
        "nfe": nfe, "checkpoint_step": step, "seeds": [first_seed, first_seed + 3],
        "protocol": {"task": "socket", "variant": "default", "max_steps": max_steps},
        "fingerprint": {"machine": {"cpu": "a fast CPU"}, "workers": 2},
    }  # fmt: skip
    folder = run / "rollouts" / f"seeds{first_seed}_nfe{nfe}_step{step}_{max_steps}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in episodes))
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def make_run(path: Path, name: str = "socket_ph32_exec16") -> Path:
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump({"name": name}))
    return path


def make_evaluated(runs: Path) -> Path:
    """A run with an evaluation that the paper has (nfe 1) and one that it has not (nfe 4)."""
    (name,) = (row.run for row in read_mapping().rows if row.name == "socket_infer1")
    path = make_run(runs / "socket_ph32_exec16" / name)
    for nfe in (4, 1):
        write_evaluation(path, nfe)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_evaluated(tmp_path / "runs")


def test_the_row_as_markdown_json_and_text(run):
    console = Console(record=True, width=200, file=open("/dev/null", "w"))  # noqa: SIM115
    print_row(RunDirectory(run), console)
    assert (run / "table_row.md").read_text() == EXPECTED
    first, second = json.loads((run / "table_row.json").read_text())
    assert (first["nfe"], first["ours"]["avg_return"], first["paper"]["avg_reward"]) == (1, 1500.0, 1275.22)
    assert (second["nfe"], second["paper"]) == (4, None)
    text = console.export_text()
    for cell in ("socket_ph32_exec16 (Table 1)", "1500.00", "1275.22", "15.0-85.0%", "84/100"):
        assert cell in text


def test_of_several_evaluations_the_reporting_band_and_the_last_weights_count(run):
    write_evaluation(run, 1, first_seed=10_000, step=30, gain=2)
    assert rows(RunDirectory(run))[0].summary["avg_return"] == 1500
    write_evaluation(run, 1, step=30, gain=3, max_steps=5)
    assert rows(RunDirectory(run))[0].summary["avg_return"] == 1500
    write_evaluation(run, 1, step=30, gain=4)
    assert rows(RunDirectory(run))[0].summary["avg_return"] == 6000


def test_rows_of_the_selection_band_are_marked(tmp_path):
    path = make_run(tmp_path / "run")
    write_evaluation(path, 1, first_seed=10_000)
    print_row(RunDirectory(path), Console(quiet=True))
    assert "Not all rows are whole episodes of the reporting band." in (path / "table_row.md").read_text()


def test_a_broken_or_incomplete_summary_is_named(run):
    path = next(run.glob("rollouts/*_nfe1_*/summary.json"))
    path.write_text("{")
    with pytest.raises(UserError, match=r"summary\.json cannot be read as JSON"):
        rows(RunDirectory(run))
    path.write_text('{"nfe": 1}')
    with pytest.raises(UserError, match=r"summary\.json lacks experiment, checkpoint_step"):
        rows(RunDirectory(run))


def test_a_run_without_evaluation_is_named(tmp_path):
    with pytest.raises(
        UserError, match=r"has no finished evaluation: make one with python -m imfvla\.evaluate"
    ):
        rows(RunDirectory(make_run(tmp_path / "run")))


def test_the_command_needs_neither_torch_nor_a_simulator(run):
    check = (
        "import sys; from imfvla.report import main; main(sys.argv[1:]); "
        "assert not {'torch', 'mujoco', 'dm_control'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", check, f"run={run}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "1275.22" in done.stdout


def test_what_was_just_evaluated_may_be_printed_alone(run):
    write_evaluation(run, 1, first_seed=10_000, gain=0.1)
    console = Console(record=True, width=200, file=open("/dev/null", "w"))  # noqa: SIM115
    print_row(RunDirectory(run), console, only=["seeds10000_nfe1_step20_None"])
    assert "150.00" in console.export_text()
    assert (run / "table_row.md").read_text() == EXPECTED


def test_failed_episodes_are_reported(run):
    write_evaluation(run, 4, failure="non-finite action")
    print_row(RunDirectory(run), Console(quiet=True))
    assert "NFE 4: 4 failed with non-finite action." in (run / "table_row.md").read_text()


def test_a_number_that_was_written_into_the_summary_is_not_printed(run):
    folder = write_evaluation(run, 1)
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"avg_return": 1234.5}))
    with pytest.raises(UserError, match=r"episodes\.jsonl gives another avg_return than its summary\.json"):
        print_row(RunDirectory(run), Console(quiet=True))
    digest = {"episodes_digest": digest_of((folder / "episodes.jsonl").read_text(encoding="utf-8"))}
    path.write_text(json.dumps(json.loads(path.read_text()) | digest))
    print_row(RunDirectory(run), Console(quiet=True))
    assert (run / "table_row.md").read_text() == EXPECTED
    assert "1234.5" not in (run / "table_row.json").read_text()


def test_a_run_without_its_rows_is_refused(run):
    (write_evaluation(run, 1) / "episodes.jsonl").unlink()
    with pytest.raises(UserError, match=r"episodes\.jsonl is missing beside its summary\.json"):
        print_row(RunDirectory(run), Console(quiet=True))


if __name__ == "__main__":  # rewrites the expected file, to review what has changed
    with tempfile.TemporaryDirectory() as directory:
        evaluated = make_evaluated(Path(directory))
        print_row(RunDirectory(evaluated), Console(quiet=True))
        EXPECTED_FILE.write_bytes((evaluated / "table_row.md").read_bytes())
