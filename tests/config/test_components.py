"""Classes of other packages: found by their entry point alone, trained like ours, refused by name otherwise."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_sweep

from imfvla.command.composition import compose
from imfvla.config import components
from imfvla.config.construction import allowed_class, construct
from imfvla.environments import environment_of
from imfvla.errors import UserError
from imfvla.policy import build_policy
from imfvla.sources import EpisodeSource
from imfvla.sources.opening import open_source
from imfvla.storage.fingerprint import fingerprint, packages
from imfvla.storage.run_directory import DONE, RunDirectory

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "tests" / "example_package"
MODULE = """
import os
from os import system
from pathlib import Path
Path({mark!r}).touch()

class Part:
    def __init__(self, size: int, extra: "Unknown" = None) -> None:
        self.size = size

class Other:
    pass

def function():
    pass
"""
POINTS = """
[imfvla.components]
part = outside_parts:Part
again = outside_parts:Part
missing = outside_parts:Missing
absent = outside_absent.module:Part
function = outside_parts:function
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the example package, installed as pip does from its sources, without a network."""
    folder = tmp_path_factory.mktemp("installed")
    sources = shutil.copytree(EXAMPLE, folder / "sources")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-build-isolation",
        "--no-deps",
        "--no-index",
    ]
    subprocess.run([*pip, "--target", str(folder / "target"), str(sources)], check=True)
    return folder / "target"


@pytest.fixture
def mark(tmp_path, monkeypatch) -> Path:
    """A package on the path, as its files lie after an installation; the file exists once its module was imported."""
    mark = tmp_path / "imported"
    folder = tmp_path / "outside_parts-1.2.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: outside-parts\nVersion: 1.2\n")
    (folder / "entry_points.txt").write_text(POINTS)
    (tmp_path / "outside_parts.py").write_text(MODULE.format(mark=str(mark)))
    monkeypatch.syspath_prepend(tmp_path)
    packages.cache_clear()
    yield mark
    packages.cache_clear()
    sys.modules.pop("outside_parts", None)


def test_a_class_is_imported_when_a_config_names_it_and_not_before(mark):
    assert "outside_parts.Part" in components.targets()
    with pytest.raises(UserError):
        allowed_class("outside_parts.Other", "core._target_")
    assert not mark.exists()
    part = construct({"_target_": "outside_parts.Part", "size": 3}, "core")
    assert mark.exists()
    assert (type(part), part.size) == (sys.modules["outside_parts"].Part, 3)
    assert fingerprint()["packages"]["outside-parts"] == "1.2"


@pytest.mark.parametrize(
    "target",
    [
        "outside_parts",
        "outside_parts:Part",
        "outside_parts.Other",
        "outside_parts.Part.__init__",
        "outside_parts.system",
        "outside_parts.os.system",
        "part",
    ],
)
def test_what_is_not_registered_is_refused_by_name(mark, target):
    with pytest.raises(
        UserError, match=r"core\._target_ must name .*imfvla\.components \(here: .*outside_parts\.Part"
    ):
        construct({"_target_": target}, "core")
    assert not mark.exists()


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            "outside_parts.Missing",
            r"cannot be imported, though outside-parts 1\.2 registers it as missing .*: Attr",
        ),
        (
            "outside_absent.module.Part",
            r"outside-parts 1\.2 registers it as absent .*: ModuleNotFoundError: No",
        ),
        (
            "outside_parts.function",
            r"outside-parts 1\.2 registers as function under .*, must be a class, found <fun",
        ),
    ],
)
def test_a_broken_entry_point_is_one_clear_error(mark, target, message):
    with pytest.raises(UserError, match=message) as caught:
        construct({"_target_": target}, "core")
    assert "\n" not in str(caught.value)


def test_arguments_are_checked_and_a_contract_is_held(mark):
    with pytest.raises(UserError, match=r"core\.size must be a whole number, found 'wide'"):
        construct({"_target_": "outside_parts.Part", "size": "wide"}, "core")
    with pytest.raises(
        UserError, match=r"core cannot be built from outside_parts\.Part: .*argument 'height'"
    ):
        construct({"_target_": "outside_parts.Part", "height": 1}, "core")
    with pytest.raises(
        UserError, match=r"demos must offer what .*EpisodeSource says, found .*Part, which lacks robot"
    ):
        construct({"_target_": "outside_parts.Part", "size": 1}, "demos", EpisodeSource)


def test_null_for_what_must_be_given_is_named():
    with pytest.raises(UserError, match=r"generator\.times must be given, as in .*conf, found None"):
        construct(compose("train", ["generator.times=null"])["generator"], "generator")


def test_a_task_its_data_and_a_generator_of_another_package_are_trained_and_evaluated(installed, tmp_path):
    paths = os.pathsep.join([str(installed), str(ROOT)])
    command = [
        sys.executable,
        "-m",
        "imfvla.train",
        "hydra.searchpath=[pkg://imfvla_example.conf]",
        "+sweep=points",
    ]
    done = subprocess.run(
        [*command, *tiny_sweep.OVERRIDES],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    runs = sorted((tmp_path / "runs" / "point").iterdir())
    assert "Warning" not in done.stderr
    assert len(runs) == 2
    for path in runs:
        run = RunDirectory(path)
        assert run.status()["state"] == DONE
        assert run.config()["robot"]["control_hz"] == 10
        assert len(list(path.glob("rollouts/*/*.mcap"))) >= 1
        # Where the package is not installed, as here:
        with pytest.raises(
            UserError, match=r"generator\._target_ must name .* found 'imfvla_example\.denoiser"
        ):
            build_policy(run.config())
        with pytest.raises(UserError, match=r"task\._target_ must name .* found 'imfvla_example\.world"):
            environment_of(run.config())
        with pytest.raises(UserError, match=r"demos\._target_ must name .* found 'imfvla_example\.world"):
            open_source(run.config())
