"""From run directories to all files of a report, or, where something is wrong, to one sentence and no file."""

import contextlib
import json
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import pytest
from synthetic_runs import answer_row, make_run, write_evaluation

from imfvla.command import publication
from imfvla.command.composition import compose
from imfvla.command.publication import publish
from imfvla.errors import UserError
from imfvla.reporting.mapping import PATH, read_mapping
from imfvla.storage.files import write_together

MAPPING = read_mapping()
STEMS = (*(table.name for table in MAPPING.tables), "others")
ROWS = {row.name: row for row in MAPPING.rows}
EXPECTED = Path(__file__).resolve().parent / "expected_tables"
ANSWERED = ("socket_infer1", "socket_infer2", "socket_ddpm_ph32", "transfer_infer1", "transfer_native_dp")


@pytest.fixture(scope="module")
def method() -> dict:
    return compose("train", ["+exp=socket_ph32_exec16"])


@pytest.fixture
def unrendered(monkeypatch):
    """Figures are drawn but not rendered, which takes most of the time."""
    monkeypatch.setattr(publication, "render", lambda figure: {".svg": b"<svg/>", ".png": b""})


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for index, name in enumerate(ANSWERED):
        answer_row(tmp_path / "runs", ROWS[name], quality=0.4 + 0.1 * index)
    return tmp_path / "runs"


@pytest.fixture(scope="module")
def tables_of_synthetic_runs(tmp_path_factory) -> dict[Path, bytes]:
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(tmp_path_factory.mktemp("synthetic"))
        return make_tables()


def make_tables() -> dict[Path, bytes]:
    """All files but figures, of runs below the working directory that are made here and the same everywhere."""
    for index, name in enumerate(ANSWERED):
        answer_row(Path("runs"), ROWS[name], quality=0.4 + 0.1 * index)
    answer_row(Path("runs"), ROWS["socket_infer2"], quality=0.55, seed=1)
    write_evaluation(
        make_run(Path("runs", "socket_ph32_exec16", "core=standard"), "socket_ph32_exec16"), 2, number=100
    )
    with mock.patch.object(publication, "_figures", return_value={}):
        return publish([Path("runs")], Path("out"), MAPPING, {}).files


def files(directory: Path) -> dict[str, bytes]:
    found = sorted(path for path in directory.rglob("*") if path.is_file())
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in found}


def test_all_files_are_there(runs, tmp_path, method):
    publish([runs], tmp_path / "out", MAPPING, method).write()
    found = files(tmp_path / "out")
    tables = {f"{stem}{suffix}" for stem in STEMS for suffix in (".md", ".csv", ".tex")}
    assert tables | {"index.html"} == {name for name in found if "/" not in name}
    figures = {name for name in found if name.startswith("figures/")}
    assert len(figures) == 18
    assert {
        f"figures/{name}.png" for name in ("figure1_overview", "figure4_ablations", "learning")
    } <= figures
    assert all(found.values())
    assert found["figures/failures.png"].startswith(b"\x89PNG")


def test_tables_without_a_measured_row_are_named_and_not_shown(runs, tmp_path, method, unrendered):
    published = publish([runs], tmp_path / "out", MAPPING, method)
    assert (
        "Table 4: object transfer while the clock runs: no row measured yet; fill it with python -m imfvla.train -m "
        "+sweep=clock"
    ) in published.left_out
    assert [table.title for table in published.tables if table.title.startswith("Table")] == [
        MAPPING.table(f"table{number}").title for number in (1, 2, 3)
    ]


def test_equal_runs_give_equal_files(runs, tmp_path, method, unrendered):
    one, other = (publish([runs], tmp_path / "out", MAPPING, method).files for _ in range(2))
    assert one == other


@pytest.mark.parametrize("name", [f"{stem}{suffix}" for stem in STEMS for suffix in (".md", ".csv", ".tex")])
def test_tables_are_byte_for_byte_those_on_file(name, tables_of_synthetic_runs):
    """python tests/test_publication.py rewrites them, to review what has changed."""
    assert tables_of_synthetic_runs[Path("out", name)] == (EXPECTED / name).read_bytes()


def test_a_row_s_number_is_that_of_its_episodes(runs, tmp_path, method, unrendered):
    publish([runs], tmp_path / "out", MAPPING, method).write()
    folder = next(runs.glob("transfer_ph32_exec16/generator=imf_plain/rollouts/*"))
    rows = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    line = next(
        line
        for line in (tmp_path / "out" / "table2.md").read_text().splitlines()
        if "| ours | " in line and "missing" not in line and "infer1, ph32" in line
    )
    assert f"| {sum(row['total_reward'] for row in rows) / 100:.2f} [" in line
    assert f"| {sum(row['success'] for row in rows)}/100 [" in line


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda runs: cut(runs, "episodes.jsonl"), r"episodes\.jsonl, line 100 is cut off"),
        (lambda runs: cut(runs, "summary.json"), r"summary\.json cannot be read as JSON"),
        (lambda runs: cut(runs, "metrics.jsonl", keep='{"st\n'), r"metrics\.jsonl, line 1 is not JSON"),
        (lambda runs: answer_row(runs / "again", ROWS["socket_infer2"]), r"row 4 \(socket_infer2\) is answered twice"),
        (lambda runs: answer_row(runs, ROWS["socket_act"], number=30), r"row 6 \(socket_act\) needs another protocol"),
        (lambda runs: answer_row(runs, ROWS["socket_act"], variant="hard"), r"table1 mixes protocols: variant is"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_the_runs_is_reported_and_nothing_written(
    runs, tmp_path, method, unrendered, damage, message
):
    damage(runs)
    with pytest.raises(UserError, match=message) as caught:
        publish([runs], tmp_path / "out", MAPPING, method).write()
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def cut(runs: Path, name: str, keep: str | None = None) -> None:
    path = next((runs / "socket_ph32_exec16").rglob(name))
    path.write_text(path.read_text()[:-20] if keep is None else keep)


def test_an_unknown_row_is_reported_and_nothing_written(runs, tmp_path):
    mapping = tmp_path / "tables.yaml"
    mapping.write_text(PATH.read_text().replace("ACT (action chunking)", "ACT (chunking)"))
    command = [sys.executable, "-m", "imfvla.report", f"directories=[{runs}]", f"output={tmp_path / 'out'}"]
    done = subprocess.run([*command, f"mapping={mapping}"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"{mapping}, line " in done.stderr
    assert (
        "unknown row of the paper's Table 1 'ACT (chunking)' (did you mean ACT (action chunking)?)"
        in done.stderr
    )
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_no_run_at_all_is_reported(tmp_path, method):
    make_run(tmp_path / "runs" / "socket_act" / "default", "socket_act")
    with pytest.raises(UserError, match=r"No run with a finished evaluation below .*make one with"):
        publish([tmp_path / "runs", tmp_path / "nothing"], tmp_path / "out", MAPPING, method)


def test_evaluations_of_no_row_have_a_table_of_their_own(runs, tmp_path, method, unrendered):
    run = make_run(runs / "socket_ph32_exec16" / "core=standard", "socket_ph32_exec16")
    write_evaluation(run, 2, number=100)
    publish([runs], tmp_path / "out", MAPPING, method).write()
    found = files(tmp_path / "out")
    assert b"socket_ph32_exec16/core=standard | 2 | step 600 of 600, seed 0 |" in found["others.md"]
    assert b"core=standard" not in found["table1.md"]


def test_the_command_needs_neither_torch_nor_a_simulator(runs, tmp_path):
    check = (
        "import sys; from imfvla.command import publication; from imfvla.report import main; "
        "publication.render = lambda figure: {'.svg': b'', '.png': b''}; main(sys.argv[1:]); "
        "assert not {'torch', 'mujoco', 'dm_control'} & set(sys.modules)"
    )
    arguments = [f"directories=[{runs}]", f"output={tmp_path / 'out'}"]
    done = subprocess.run(
        [sys.executable, "-c", check, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Table 3: derived comparisons" in done.stdout
    assert str(tmp_path / "out" / "index.html") in done.stdout


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as directory, contextlib.chdir(directory):
        for path, content in make_tables().items():
            if path.stem in STEMS:
                write_together({EXPECTED / path.name: content})
                print(EXPECTED / path.name)
    runpy.run_path(str(EXPECTED.parent / "reporting" / "test_table_row.py"), run_name="__main__")
