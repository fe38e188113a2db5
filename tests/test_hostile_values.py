"""Files that parse and hold what no consumer can use: each reader refuses them, and names key and value."""

import json
import os
import struct
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
import yaml
from synthetic import write_demonstrations, write_episode
from synthetic_runs import make_run, write_evaluation

from imfvla.command.composition import compose
from imfvla.command.rehearsal import checked_options
from imfvla.data import FrameStore, ResumableSampler
from imfvla.errors import UserError
from imfvla.figures.depth_attention import depth_attention, read_depth_attention
from imfvla.figures.learning import learning_curves
from imfvla.figures.style import style
from imfvla.policy import build_policy
from imfvla.recording import read_episode
from imfvla.recording.mcap_file import FOOTER_SIZE, MAGIC, RECORD_HEAD
from imfvla.reporting.answers import Sources, read_evaluated
from imfvla.reporting.offline import read_offline
from imfvla.reporting.results import Result
from imfvla.reporting.runs import evaluations
from imfvla.reporting.table_row import print_row
from imfvla.robot import Camera
from imfvla.rollouts.rollout_log import PARTIAL, RolloutLog
from imfvla.sources.mcap import McapSource
from imfvla.storage import documents
from imfvla.storage.documents import MAX_YAML_VALUES
from imfvla.storage.metrics import read_metrics
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.train_state import TrainState, load_state, save_state

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))
from mcap_check import check  # noqa: E402
from mcap_to_mp4 import export  # noqa: E402

HUGE = 10**400
MATHTEXT = r"$\frac{ $"


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    run = RunDirectory(make_run(tmp_path / "runs" / "x" / "default", "x"))
    write_evaluation(run.path, 1, number=3)
    return run


def changed(value, path: str, new):
    """The value with another one at a dotted path, or without it where `new` is Ellipsis."""
    value = deepcopy(value)
    *parents, last = path.split(".")
    part = value
    for name in parents:
        part = part[name]
    if new is ...:
        del part[last]
    else:
        part[last] = new
    return value


def change_file(path: Path, key: str, new) -> None:
    path.write_text(json.dumps(changed(json.loads(path.read_text()), key, new)))


def folder_of(run: RunDirectory) -> Path:
    return next(run.path.glob("rollouts/*"))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("avg_return", "x", "avg_return must be a finite number, found 'x'"),
        ("avg_return", True, "avg_return must be a finite number, found True"),
        ("avg_return", HUGE, "avg_return must be a finite number"),
        ("avg_return", 1e300, "avg_return must be between"),
        ("median_return", float("nan"), "median_return must be a finite number, found nan"),
        ("success_interval", 0, "success_interval must be a list, found 0"),
        ("success_interval", [0.1], "success_interval must be a list of 2 entries"),
        ("failures", 0.5, "failures must be a mapping"),
        ("failures", {"x": -1}, "failures.x must be between 0"),
        ("fingerprint.machine", "x", "fingerprint.machine must be a mapping"),
        ("fingerprint.code", "x", "fingerprint.code must be a mapping"),
        ("protocol.task", ..., "protocol lacks task"),
        ("protocol.task", ["socket"], r"protocol.task must be a text"),
        ("protocol", [], "protocol must be a mapping"),
        ("recordings", {"best": "x"}, "recordings.best must be a mapping"),
        ("recordings", {"best": {"seed": 1, "return": 1.0, "file": "../x.mcap"}}, "file must be the name of a file"),
        ("episodes", "3", "episodes must be a whole number, found '3'"),
        ("episodes", 2, "gives another episodes than its summary"),
        ("seeds", [0, 2**32 - 1], "seeds must be"),
        ("experiment", "", "experiment must be a text of 1 to 200"),
        ("experiment", "a\x1b[31m", "experiment must be a text of 1 to 200 printable"),
        ("stages", ["a"] * 1000, "stages must be of length 100 at most"),
        ("nfe", 0, "nfe must be between 1"),
        ("experiment", "../x", "experiment must be the name of a file, without a directory"),
        ("protocol.delay_ms", 20, "has delay_ms 20 on a paused clock"),
        ("protocol.meanwhile", "continue", "has meanwhile 'continue' on a paused clock"),
        ("protocol.condition", "bump", "has the condition bump with severity None"),
        ("protocol.severity", 2, "has the condition none with severity 2"),
        ("other", {"deep": [[[[]]] * 3]}, None),
    ],
)  # fmt: skip
def test_a_summary_is_what_it_should_be(run, key, value, message):
    change_file(folder_of(run) / "summary.json", key, value)
    if message is None:
        print_row(run)
        return
    with pytest.raises(UserError, match=message):
        print_row(run)


@pytest.mark.parametrize(
    ("rows", "key", "value", "message"),
    [
        ([1], "goal", "transfer", "has a goal in 1 of 3 rows"),
        ([0, 1, 2], "goal", [1], r"line 1: goal must be a text, found \[1\]"),
        ([1], "num_steps", HUGE, "line 2: num_steps must be a whole number up to"),
        (
            [0, 1, 2],
            "timing.inference_ms",
            [0, 0],
            r"line 1: timing.inference_ms\[0\] must be above 0, found 0",
        ),
        ([2], "timing.inference_ms", ["1.5"], r"line 3: timing.inference_ms\[0\] must be a finite number"),
        ([0], "seed", True, "line 1: seed must be a whole number, found True"),
        ([0], "success", "yes", "line 1: success must be true or false"),
        ([0], "first_step_of_stage", [1] * 1000, "line 1: first_step_of_stage must be of length 100 at most"),
        ([0], "total_reward", -1e308, "line 1: total_reward must be between"),
    ],
)
def test_episodes_are_what_they_should_be(run, rows, key, value, message):
    path = folder_of(run) / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines = [changed(line, key, value) if number in rows else line for number, line in enumerate(lines)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(UserError, match=message):
        read_evaluated(evaluations(run)[0])


def test_a_pipe_is_not_taken_for_rows_that_were_left(tmp_path):
    os.mkfifo(tmp_path / PARTIAL)
    with pytest.raises(UserError, match="Wanted a file, found a named pipe"), RolloutLog(tmp_path, {}) as log:
        log.begin()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: [1]", r"seed must be a whole number, found \[1\]"),
        ("seed: '1'", "seed must be a whole number, found '1'"),
        ("seed: -1", "seed must be between 0 and"),
        ("name: ../../x", "name must be the name of a file, without a directory"),
        ("name: 5", "name must be a text"),
        ("core: {_target_: 5}", "core._target_ must be a text"),
        ("generator: imf", "generator must be a mapping"),
        ("training: {steps: .inf}", "training.steps must be a finite number"),
        ("note: 2020-01-01", "note must be a number, a text, true, false"),
        ("1: x", "a key of it must be a text, found 1"),
        ("x: 0b" + "1" * 20_000, "x must be a whole number up to .*found a number of thousands of digits"),
        ("x: {" + "a," * 100_000 + "}", f"more than {MAX_YAML_VALUES} keys and values"),
    ],
)
def test_a_config_is_what_it_should_be(run, text, message):
    (run.path / "config.yaml").write_text(f"{text}\n")
    with pytest.raises(UserError, match=rf"config\.yaml.*{message}"):
        run.config()


@pytest.mark.parametrize(
    "row",
    [{"step": -1e308}, {"step": True}, {"loss": 1.0}, {"step": 1, "loss": "2"}, {"step": 1, "lr": [1]}, 5],
)
def test_metrics_are_what_they_should_be(run, row):
    run.metrics.write_text(json.dumps(row) + "\n")
    with pytest.raises(UserError, match=r"metrics\.jsonl, line 1"):
        read_metrics(run.metrics)


LATENCY = {"median_ms": 5.0, "p95_ms": 6.0, "calls": 20, "at": "now", "load": 1.0}


@pytest.mark.parametrize(
    ("latency", "message"),
    [
        (None, "has a measured delay, but lacks latency_alone"),
        (LATENCY | {"nfe": 3}, "has a latency of nfe 3, but its protocol has 1"),
        (LATENCY | {"median_ms": 0}, "latency_alone.median_ms must be above 0"),
        (LATENCY | {"median_ms": HUGE}, "latency_alone.median_ms must be a finite number"),
        (LATENCY | {"nfe": 1}, None),
    ],
)
def test_a_measured_delay_comes_with_what_was_measured(run, latency, message):
    path = folder_of(run) / "summary.json"
    change_file(path, "protocol.clock", "running")
    change_file(path, "protocol.delay_ms", "measured")
    if latency is not None:
        change_file(path, "latency_alone", latency)
    if message is None:
        print_row(run)
        return
    with pytest.raises(UserError, match=message):
        print_row(run)


def test_a_long_list_of_what_nobody_reads_is_checked_without_a_name_for_each(run):
    path = folder_of(run) / "summary.json"
    many = [*range(1000), None, True, 1.5]
    change_file(path, "other", many)
    assert evaluations(run)[0].summary["other"] == many
    change_file(path, "other", [*many, HUGE])
    with pytest.raises(UserError, match=r"other\[1003\] must be a whole number up to"):
        evaluations(run)


def test_json_of_very_many_parts_is_refused_before_it_is_parsed(run, monkeypatch):
    monkeypatch.setattr(documents.refuse_many_parts, "__defaults__", (1000,))
    change_file(folder_of(run) / "summary.json", "other", [[]] * 1000)
    with pytest.raises(UserError, match="keys, lists and mappings, wanted at most 1000"):
        evaluations(run)


def test_metrics_of_whole_numbers_and_nothing_are_rows(run):
    rows = [{"step": 1, "loss": 2}, {"step": 2, "loss": None, "lr": -(10**300)}]
    run.metrics.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert read_metrics(run.metrics) == rows


@pytest.mark.parametrize("value", [True, "1", [1.0], {}, HUGE])
def test_one_bad_metric_of_many_is_named(run, value):
    run.metrics.write_text('{"step": 1, "loss": 1.0}\n' + json.dumps({"step": 2, "lr": value}) + "\n")
    with pytest.raises(UserError, match=r"metrics\.jsonl, line 2: lr must be null or a number"):
        read_metrics(run.metrics)


def test_metrics_may_have_no_number(run):
    run.metrics.write_text('{"step": 1, "loss": NaN}\n{"step": 2, "loss": null}\n')
    assert [row["step"] for row in read_metrics(run.metrics)] == [1, 2]


def test_a_status_is_what_it_should_be(run):
    (run.path / "status.json").write_text('{"state": "finished"}')
    with pytest.raises(UserError, match="state must be one of running, done, failed"):
        run.status()


DETAILS = {
    "step": 3,
    "train_s": 1.5,
    "precision": "fp32",
    "gradient_scale": None,
    "batches": {},
    "logger": {"sums": {"loss": 1.0}, "count": 1},
}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("logger.sums", {"loss": "x"}, "logger.sums.loss must be a number, found 'x'"),
        ("logger.count", -1, "logger.count must be between 0"),
        ("step", -1, "step must be between 0"),
        ("step", "3", "step must be a whole number"),
        ("precision", "fp16", "precision must be one of fp32, bf16"),
        ("gradient_scale", -1.0, "gradient_scale must be null or between 0"),
        ("batches", [], "batches must be a mapping"),
        ("logger", ..., "details lacks logger"),
        ("code", 5, "code must be a mapping"),
        ("earlier_code", [{"until_step": 1, "code": "x"}], "code must be a mapping"),
        ("config", [], "config must be null or a mapping"),
    ],
)
def test_a_state_is_what_it_should_be(tmp_path, key, value, message):
    policy = torch.nn.Linear(3, 2)
    state = TrainState(policy, torch.nn.Linear(3, 2), torch.optim.AdamW(policy.parameters()))
    save_state(tmp_path / "state.safetensors", state, changed(DETAILS, key, value))
    with pytest.raises(UserError, match=rf"state\.safetensors.*{message}"):
        load_state(tmp_path / "state.safetensors", state)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"next_batch": ...}, "lacks next_batch"),
        ({"next_batch": "5"}, "next_batch must be a whole number"),
        ({"seed": 7}, "was made with seed 7"),
    ],
)
def test_the_batches_of_a_state_are_what_they_should_be(change, message):
    sampler = ResumableSampler(100, 8, 0)
    with pytest.raises(UserError, match=message):
        sampler.load_state_dict({k: v for k, v in (sampler.state_dict() | change).items() if v is not ...})


def test_paraphrases_are_texts(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic, "PARAPHRASES", 5)
    write_episode(tmp_path / "a.mcap", 0, num_steps=3, views=("front",), image_size=(16, 16))
    with pytest.raises(UserError, match=r"a\.mcap: metadata\.paraphrases must be a list, found 5"):
        read_episode(tmp_path / "a.mcap")


def test_the_check_of_recordings_looks_at_the_end_too(tmp_path):
    path = tmp_path / "a.mcap"
    write_episode(path, 0, num_steps=3, views=("front",), image_size=(16, 16))
    whole = path.read_bytes()
    assert check(path)[1] == []
    path.write_bytes(whole + b"xyz")
    assert check(path)[1] == ["3 bytes are behind its end"]
    place = len(whole) - len(MAGIC) - FOOTER_SIZE + RECORD_HEAD.size
    path.write_bytes(whole[:place] + struct.pack("<Q", 0) + whole[place + 8 :])
    (problem,) = check(path)[1]
    assert problem.endswith("its footer says 0")


def test_a_video_has_views_of_any_sizes(tmp_path, monkeypatch):
    cameras = (Camera("front", 16, 40), Camera("top", 33, 7))
    robot = synthetic.bimanual_robot
    monkeypatch.setattr(
        synthetic,
        "bimanual_robot",
        lambda views, size: type(whole := robot(views, size))(
            **{name: getattr(whole, name) for name in whole.__slots__ if name != "cameras"}, cameras=cameras
        ),
    )
    write_episode(tmp_path / "a.mcap", 0, num_steps=3, views=("front", "top"), image_size=(16, 16))
    export(tmp_path / "a.mcap", tmp_path / "a.mp4", None)
    assert (tmp_path / "a.mp4").stat().st_size > 0


@pytest.mark.parametrize("image_size", [[-1, 16], [100_000, 16], [16], ["16", 16], [16.0, 16], [True, 16]])
def test_the_size_of_stored_pictures_is_possible(tmp_path, image_size):
    demos = write_demonstrations(tmp_path / "demos", num_episodes=1, num_steps=4)
    FrameStore.build(McapSource.of(demos), tmp_path / "store", (16, 16), ("front",))
    change_file(tmp_path / "store" / "meta.json", "image_size", image_size)
    with pytest.raises(UserError, match="image_size"):
        FrameStore.open(tmp_path / "store")


def test_frames_are_of_steps_that_exist(tmp_path):
    demos = write_demonstrations(tmp_path / "demos", num_episodes=1, num_steps=4)
    FrameStore.build(McapSource.of(demos), tmp_path / "store", (16, 16), ("front",))
    steps = np.load(tmp_path / "store" / "image_steps.npy", allow_pickle=False)
    np.save(tmp_path / "store" / "image_steps.npy", steps + 5, allow_pickle=False)
    with pytest.raises(UserError, match=r"cannot be read"):
        FrameStore.open(tmp_path / "store")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("actions", [[0.5] * 2000] * 2000, "actions must be of length 200 at most"),
        ("actions", [[0.5] * 2000], r"actions\[0\] must be of length 200 at most"),
        ("actions", [[1.5]], r"actions\[0\]\[0\] must be between 0 and 1"),
        ("actions", [["1"]], r"actions\[0\]\[0\] must be a finite number"),
        ("actions", [[]], "actions must be weights of at least one sublayer"),
        ("experiment", ..., "lacks experiment"),
    ],
)
def test_depth_weights_are_what_they_should_be(tmp_path, key, value, message):
    whole = {"experiment": "x", "checkpoint_step": 3, "actions": [[1.0]], "context": []}
    path = tmp_path / "depth_attention.json"
    path.write_text(json.dumps(changed(whole, key, value)))
    with pytest.raises(UserError, match=rf"depth_attention\.json.*{message}"):
        read_depth_attention(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("error.infer1", [[1.0]], "error of infer1 must be a number for each step"),
        ("error.hold still", ..., "error must be of hold still"),
        ("executed", 5, "error of hold still"),
        ("protocol.held_out", 3, "protocol.held_out must be a list"),
        (
            "error.infer0",
            [[0.1, 0.2]],
            "a key must be hold still, nearest demonstration or infer and a number",
        ),
        ("error.infer1", [[0.1] * 2000], r"error.infer1\[0\] must be of length 1000 at most"),
    ],
)
def test_offline_results_are_what_they_should_be(run, key, value, message):
    errors = [[0.1, None], [0.2, 0.4]]
    whole = {
        "experiment": "x", "protocol": {"checkpoint_step": 3, "held_out": ["demo_1"]}, "decisions": 5, "executed": 1,
        "channels": ["a", "b"], "deviation": [0.5, 0.0],
        "error": {"hold still": errors, "nearest demonstration": errors, "infer1": errors},
    }  # fmt: skip
    (run.path / "offline.json").write_text(json.dumps(whole))
    assert read_offline(run) == whole
    (run.path / "offline.json").write_text(json.dumps(changed(whole, key, value)))
    with pytest.raises(UserError, match=message):
        read_offline(run)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("core.depth", 10**6, r"core\.depth must be between 1 and 256"),
        ("core.width", 10**6, r"core\.width must be between 1 and 16384"),
        ("core.depth", True, r"core\.depth must be a whole number"),
        ("core.mlp_ratio", 1e6, "more than 2e\\+09 parameters"),
        ("observation.image_size", [-1, 32], "observation.image_size must be"),
        ("observation.image_size", [100_000, 32], "observation.image_size must be"),
    ],
)
def test_a_policy_of_impossible_size_is_not_built(key, value, message):
    config = compose("train", ["+exp=socket_ph32_exec16"])
    with pytest.raises(UserError, match=message):
        build_policy(changed(config, key, value))


def test_a_name_that_cannot_be_printed_is_refused_before_training():
    config = compose("train", ["+exp=socket_ph32_exec16"])
    with pytest.raises(UserError, match="name must be a text of 1 to 200 printable characters"):
        checked_options(config | {"name": "a\nb"})


def test_a_name_in_figures_is_no_formula(tmp_path):
    run = RunDirectory(make_run(tmp_path / "x" / "default", MATHTEXT))
    write_evaluation(run.path, 1, number=3)
    results = [Result(found) for found in Sources([tmp_path]).others([])]
    weights = {"experiment": MATHTEXT, "checkpoint_step": 3, "actions": [[1.0]], "context": []}
    for figure in (learning_curves(results), depth_attention([weights])):
        with style():
            figure.draw_without_rendering()


def test_configs_of_old_runs_stay_readable():
    """The shipped ones, whole."""
    root = ROOT / "experiments"
    for path in [*root.glob("pretrained/*/*/config.yaml"), *root.glob("results/*/*/config.yaml")]:
        run = RunDirectory(path.parent)
        assert run.config() == yaml.safe_load(path.read_text(encoding="utf-8"))
        assert run.status()["state"] == "done"
        assert evaluations(run)
        assert read_metrics(run.metrics)
