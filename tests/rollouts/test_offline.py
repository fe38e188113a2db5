"""Without an environment: errors that are known, their tables, and a run that ends with them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from any_robot import MemorySource, robot_of_size
from test_any_robot import configured

from imfvla.command.completion import is_complete
from imfvla.command.composition import compose
from imfvla.command.experiment import run_experiment
from imfvla.command.publication import publish
from imfvla.errors import UserError
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.offline import HOLD, NEAREST, read_offline
from imfvla.reporting.offline_tables import by_channel, by_step, offline_table
from imfvla.rollouts.offline import _errors, _hold, _nearest
from imfvla.storage.run_directory import RunDirectory

ROBOT = robot_of_size(7, 7)


def test_holding_still_keeps_what_an_action_displaces_and_the_mean_where_no_state_is_named_so():
    state = np.arange(7, dtype=np.float32)[None]
    held = _hold(state, ROBOT, np.full(7, 0.5, np.float32))
    assert held.tolist() == [[1, 2, 3, 4, 5, 6, 0.5]]


def test_the_nearest_decision_is_found_whatever_the_units():
    known = np.array([[0, 0], [1, 1000], [2, 0]], np.float32)
    actions = np.arange(3, dtype=np.float32).reshape(3, 1, 1)
    assert _nearest(np.array([[1.9, 100], [1, 900]], np.float32), known, actions).ravel().tolist() == [2, 1]


def test_steps_past_the_end_do_not_count():
    actions, chunks = np.zeros((2, 3, 1)), np.ones((2, 3, 1))
    chunks[1] = 3
    valid = np.array([[True, True, False], [True, False, False]])
    np.testing.assert_array_equal(_errors(chunks, actions, valid).ravel(), [2, 1, np.nan])


@pytest.fixture
def run(tmp_path, monkeypatch) -> RunDirectory:
    """A finished run on four episodes of which one is held out; it is done again where a test runs it again."""
    source = MemorySource(ROBOT)
    monkeypatch.setattr("imfvla.sources.mcap.open_source", lambda options, *, where: source)
    monkeypatch.setattr(
        "imfvla.command.experiment.select_gl_backend", lambda: pytest.fail("nothing is rendered")
    )
    run = RunDirectory(tmp_path / "runs" / "none" / "default")
    run_experiment(settings(tmp_path), run)
    return run


def settings(tmp_path, *overrides: str) -> dict:
    return configured("demos.path=none", f"demos.frames_directory={tmp_path}/frames", *overrides)


def test_a_run_ends_with_errors_in_physical_units(run, tmp_path, capsys):
    found = read_offline(run)
    assert list(found["error"]) == [HOLD, NEAREST, "infer1", "infer2"]
    assert found["protocol"]["held_out"] == ["episode 2"]
    assert found["decisions"] == 10
    error = np.array(found["error"][HOLD], float)
    assert error.shape == (8, 7)
    # The first action is the state it displaces, off by noise of 0.1.
    assert error[0, :6] == pytest.approx(np.full(6, 0.1 * np.sqrt(2 / np.pi)), abs=0.06)
    assert (
        (run.path / "offline.md")
        .read_text()
        .startswith("## none: error by channel, over the 4 executed steps")
    )
    assert is_complete(settings(tmp_path), run.path)
    assert not is_complete(settings(tmp_path, "evaluation.nfe=[3]"), run.path)
    assert not is_complete(settings(tmp_path, "task.held_out=2"), run.path)


def test_a_finished_run_is_only_read_and_other_held_out_episodes_are_another_run(run, tmp_path):
    before = (run.path / "offline.json").stat().st_mtime_ns
    run_experiment(settings(tmp_path), run)
    assert (run.path / "offline.json").stat().st_mtime_ns == before
    run_experiment(settings(tmp_path, "evaluation.nfe=[3]"), run)
    assert list(read_offline(run)["error"]) == [HOLD, NEAREST, "infer3"]
    with pytest.raises(UserError, match=r"another config: task\.held_out was 1, is 2"):
        run_experiment(settings(tmp_path, "task.held_out=2"), run)


def test_other_recordings_are_another_run(run, tmp_path):
    """Where scripted demonstrations lie does not matter, but which recordings are trained on does."""
    with pytest.raises(UserError, match=r"another config: demos\.path was 'none', is 'other'"):
        run_experiment(settings(tmp_path, "demos.path=other"), run)


def test_data_of_another_robot_does_not_go_on_with_a_run(run, tmp_path, monkeypatch):
    faster = MemorySource(replace(ROBOT, control_hz=20.0))
    monkeypatch.setattr("imfvla.sources.mcap.open_source", lambda options, *, where: faster)
    with pytest.raises(
        UserError, match=r"its data has another robot than the run in .* must be 10, found 20"
    ):
        run_experiment(settings(tmp_path), run)


def test_the_report_has_a_table_of_them(run, tmp_path):
    method = compose("train", ["+exp=socket_ph32_exec16"])
    published = publish([tmp_path / "runs"], tmp_path / "out", read_mapping(), method)
    text = published.files[tmp_path / "out" / "offline.md"].decode()
    assert "| none | 1 | 2 | 1 | 10 |" in text
    assert "no environment was played" in text


def test_a_damaged_file_is_named(run):
    content = json.loads((run.path / "offline.json").read_text())
    for damage in ({"channels": ["a"]}, {"error": None}, {"decisions": "many"}):
        (run.path / "offline.json").write_text(json.dumps(content | damage))
        with pytest.raises(UserError, match=r"offline\.json.*move it away"):
            read_offline(run)


def numbers() -> dict:
    rows = enumerate((HOLD, NEAREST, "infer1"))
    return {
        "experiment": "pick",
        "protocol": {"checkpoint_step": 9, "held_out": ["a", "b"]},
        "decisions": 5,
        "executed": 2,
        "channels": ["x [m]", "still [m]"],
        "deviation": [2.0, 0.0],
        "error": {name: [[step + shift, 0.0] for step in range(3)] for shift, name in rows},
    }


def test_tables_by_channel_step_and_run():
    found = numbers()
    assert by_channel(found).rows == (
        ("x [m]", "0.5000", "1.5000", "2.5000"),
        ("still [m]", "0.0000", "0.0000", "0.0000"),
    )
    assert [row[0] for row in by_step(found).rows] == ["1", "2", "3"]
    assert by_step(found).rows[2] == (
        "3",
        "1.0000",
        "1.5000",
        "2.0000",
    )  # in deviations, without the still one
    assert offline_table([("pick", found)]).shown.rows == (
        ("pick", "1", "9", "2", "5", "1.2500", "0.2500", "0.7500"),
    )
