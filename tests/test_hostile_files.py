"""Files and configs from strangers: only a UserError comes out, nothing of theirs is run, nothing leaves its place."""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic import write_episode

from imfvla.command.composition import compose
from imfvla.command.experiment import run_experiment
from imfvla.config.construction import allowed_class, construct
from imfvla.errors import UserError
from imfvla.policy import build_policy
from imfvla.recording import McapSink, read_episode
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.run_names import run_name

ROOT = Path(__file__).resolve().parent.parent
TREE = subprocess.run(
    ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
    cwd=ROOT, capture_output=True, text=True, check=True,
).stdout.splitlines()  # fmt: skip


def load_tool(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def fuzz():
    path = list(sys.path)
    yield load_tool("fuzz")
    sys.path[:] = path


@pytest.fixture(scope="module")
def targets(fuzz, tmp_path_factory):
    return fuzz.make_targets(tmp_path_factory.mktemp("targets"))


READERS = (
    "mcap", "mcap_index", "state", "weights", "pretrained", "config", "status", "latency", "made_by",
    "overrides", "collected", "summary", "episodes", "partial",
    "metrics", "curve", "depth_attention", "store_meta", "store_array", "options", "tables",
)  # fmt: skip
WITH_EXTRAS = (
    "lerobot_info", "lerobot_stats", "lerobot_tasks", "lerobot_data", "lerobot_rows", "lerobot_video",
    "lerobot_robot", "ros2", "hdf5",
)  # fmt: skip
CONSUMERS = (
    "report_summary", "report_episodes", "report_config", "report_metrics", "report_depth_attention",
    "settings_running", "settings_bump", "report_offline",
    "compare_summary", "compare_episodes", "evaluate_config", "evaluate_summary", "evaluate_partial", "resume_state",
    "resume_metrics", "mcap_check", "mcap_to_mp4",
)  # fmt: skip


def test_every_reader_is_fuzzed(targets):
    assert tuple(targets)[: len(READERS)] == READERS
    assert tuple(targets)[-len(CONSUMERS) :] == CONSUMERS
    assert set(targets) - {*READERS, *CONSUMERS} <= set(WITH_EXTRAS)


@pytest.mark.parametrize("name", [*READERS, *WITH_EXTRAS])
@settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(10**6, 2**32))
def test_of_a_damaged_file_comes_a_value_or_a_user_error(fuzz, targets, name, seed):
    if name not in targets:
        pytest.skip("needs an extra: lerobot, ros2 or hdf5")
    tally = fuzz.fuzz(targets[name], 1, seed)
    assert not tally.failures


@pytest.mark.parametrize("name", CONSUMERS)
@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(10**6, 2**32))
def test_what_is_read_of_a_damaged_file_can_be_used(fuzz, targets, name, seed):
    tally = fuzz.fuzz(targets[name], 1, seed)
    assert not tally.failures


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(content=st.binary(max_size=200))
@pytest.mark.parametrize("name", ["mcap", "state", "config", "summary", "metrics", "store_array"])
def test_of_any_bytes_comes_a_value_or_a_user_error(fuzz, targets, name, content):
    target = fuzz.Target(targets[name].path, targets[name].read, lambda data, rng: content)
    assert not fuzz.fuzz(target, 1, 0).failures


def test_the_fuzzer_tells_another_error_and_a_reader_that_does_not_end(fuzz, tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"whole")

    def read(path):
        if len(path.read_bytes()) > 2:
            raise KeyError("a mistake of ours")
        while True:
            pass

    monkeypatch.setattr(fuzz, "MAX_SECONDS", 0.05)
    cut = fuzz.Target(tmp_path / "file", read, lambda data, rng: data[: rng.randrange(len(data) + 1)])
    failures = fuzz.fuzz(cut, 8, 0).failures
    assert len(failures) == 8
    assert any("a mistake of ours" in failure for failure in failures)
    assert any("TooSlow" in failure for failure in failures)
    assert (tmp_path / "file").read_bytes() == b"whole"


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "imfvla.storage.files.os.system",
        "imfvla.storage.files.write_text",
        "imfvla.encoders.vision.torch.load",
        "imfvla.nn.pretrained.load_file",
        "imfvla.nn.residual.nn.Module",
        "imfvla.training.logger.MetricsLogger",
        "imfvla.nn",
        "imfvla.nn.nowhere.Core",
        "torch.load",
        "torch.optim.AdamW",
        "hydra.utils.call",
        "builtins.eval",
        "",
        None,
        ["imfvla.nn.transformer.TransformerCore"],
    ],
)
def test_a_config_cannot_name_what_is_run(target):
    with pytest.raises(UserError, match="must not choose what is run"):
        construct({"_target_": "imfvla.generators.base.UniformTimes", "part": [{"_target_": target}]}, "core")


def test_our_parts_may_be_named():
    assert construct({"_target_": "imfvla.generators.base.UniformTimes"}, "times") is not None


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    name=st.lists(
        st.sampled_from(["imfvla", "nn", "files", "os", "torch", "optim", "a", "__class__"]), max_size=5
    )
)
def test_whatever_is_named_is_refused_or_a_class_of_ours(name):
    with pytest.raises(UserError, match="must name a class defined in"):
        allowed_class(".".join(name), "core._target_")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("_args_", [1], "_args_ is not allowed"),
        ("_recursive_", False, "_recursive_ is not allowed"),
        ("width", "${oc.env:HOME}", "must be a plain value, found the interpolation"),
    ],
)
def test_hydras_other_powers_are_refused(key, value, message):
    config = compose("train", ["+exp=socket_ph32_exec16"])
    config["core"][key] = value
    with pytest.raises(UserError, match=message):
        build_policy(config)


def test_a_run_directory_of_a_stranger_runs_nothing(tmp_path):
    """The config is read and refused; what it names is never called."""
    run = RunDirectory(tmp_path / "run")
    config = compose("train", ["+exp=socket_ph32_exec16"])
    config["generator"] = {"_target_": "imfvla.storage.files.os.system", "command": f"touch {tmp_path}/owned"}
    run.claim(config)
    with pytest.raises(UserError, match=r"generator\._target_ must name a class"):
        build_policy(run.config())
    assert not (tmp_path / "owned").exists()


PICKLERS = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "pandas"}
# Calls that read or write pickles, or run text, beside those modules. `np.load` does unless it is forbidden to.
FORBIDDEN_CALLS = {
    "torch.load",
    "torch.save",
    "read_pickle",
    "to_pickle",
    "unsafe_load",
    "eval",
    "exec",
    "full_load",
}


def test_no_code_reads_or_writes_pickles():
    offenders = [
        f"{path}:{node.lineno} {found}"
        for path in TREE
        if path.endswith(".py") and (ROOT / path).is_file()
        for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8")))
        if (found := pickles(node, is_test=path.startswith("tests/")))
    ]
    assert not offenders


def pickles(node: ast.AST, is_test: bool) -> str | None:
    """What in a node of code reads or writes pickles, or runs text; a test may write the pickle to be refused."""
    modules: list[str] = []
    if isinstance(node, ast.Import):
        modules = [name.name for name in node.names]
    elif isinstance(node, ast.ImportFrom):
        modules = [node.module or ""]
    if found := {module.split(".")[0] for module in modules} & PICKLERS:
        return f"import {found.pop()}"
    if not isinstance(node, ast.Call):
        return None
    called = ast.unparse(node.func)
    allows = [ast.unparse(word.value) for word in node.keywords if word.arg == "allow_pickle"]
    is_array = called in ("np.load", "np.save", "np.savez", "numpy.load") and allows != ["False"]
    is_sent = called.endswith(("_object_list", "gather_object"))
    return called if is_array or is_sent or (called in FORBIDDEN_CALLS and not is_test) else None


def test_no_file_of_the_tree_is_a_pickle():
    suffixes = {".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".joblib", ".npy", ".npz"}
    assert not [path for path in TREE if Path(path).suffix in suffixes]
    for path in TREE:
        start = (ROOT / path).read_bytes()[:2] if (ROOT / path).is_file() else b""
        assert start not in (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"), path


@settings(max_examples=300, deadline=None, derandomize=True)
@given(overrides=st.lists(st.text(max_size=30), max_size=4))
def test_a_run_is_named_within_its_folder(overrides):
    name = run_name(overrides)
    assert name not in ("", ".", "..")
    assert not {"/", "\\", "\0"} & set(name)
    assert len(os.fsencode(name)) < 200


def test_an_attachment_is_read_and_never_written(fuzz, tmp_path):
    """Attachments whose names are paths leave no file anywhere."""
    write_episode(tmp_path / "a.mcap", 0, num_steps=3, views=("front",), image_size=(16, 16))
    renamed = (tmp_path / "a.mcap").read_bytes().replace(b"config.json", b"../../a.txt")
    (tmp_path / "a.mcap").write_bytes(renamed)
    with pytest.raises(UserError, match=r"a\.mcap is damaged"):
        read_episode(tmp_path / "a.mcap")  # its checksum is of the old name
    assert [path.name for path in tmp_path.rglob("*")] == ["a.mcap"]
    assert McapSink(tmp_path / "b.mcap").path.parent == tmp_path


@pytest.mark.parametrize("link", [".lock", "metrics.jsonl", "rollouts", "checkpoints/last"])
def test_a_link_that_leads_out_of_a_run_directory_is_refused(tmp_path, link):
    run = RunDirectory(tmp_path / "run")
    (run.path / link).parent.mkdir(parents=True)
    (run.path / "here").symlink_to(run.path / "status.json")
    run.refuse_strangers()
    (tmp_path / "precious").write_text("of the user")
    (run.path / link).symlink_to(tmp_path / "precious")
    with pytest.raises(UserError, match=f"links out of {run.path}"):
        run.refuse_strangers()
    with pytest.raises(UserError, match=f"links out of {run.path}"):
        run_experiment(compose("train", ["observation.image_size=[32,32]"]), run)
    assert (tmp_path / "precious").read_text() == "of the user"
