"""A built wheel: it carries the files that commands read, and works from an empty directory."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BESIDE = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "experiments/tables.yaml")
TINY = [
    "observation.image_size=[16,24]", "size.width=20", "size.heads=2", "size.depth=1", "horizon.pred=4",
    "horizon.exec=2", "training.batch_size=2", "training.steps=2", "training.checkpoints=1", "evaluation.nfe=[1]",
]  # fmt: skip
COMPOSE = """
import json
import imfvla
from imfvla.config.assets import install_command
from imfvla.command.composition import compose
from imfvla.reporting.mapping import read_mapping
config = compose("train", ["+exp=transfer_dwell"])
print(json.dumps([imfvla.__file__, config["name"], len(read_mapping().rows), install_command("slurm")]))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built without a network from a copy of the sources, so that nothing is left behind in them."""
    folder = tmp_path_factory.mktemp("wheel")
    sources = folder / "sources"
    for name in ("imfvla", "conf", "experiments/paper"):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in BESIDE:
        shutil.copy(ROOT / name, sources / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index"]
    subprocess.run([*pip, "-w", str(folder), str(sources)], check=True)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def unpacked(wheel) -> Path:
    """As pip lays it out: a wheel of Python files is installed by being unpacked."""
    zipfile.ZipFile(wheel).extractall(wheel.parent / "site")
    return wheel.parent / "site"


def run(unpacked: Path, directory: Path, *arguments: str) -> subprocess.CompletedProcess:
    """Python in `directory`, which finds this imfvla before any other."""
    environment = os.environ | {"PYTHONPATH": str(unpacked)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


def test_it_holds_every_module_config_and_table_and_nothing_else(unpacked):
    def files(folder: Path, *patterns: str) -> set[Path]:
        return {path.relative_to(folder) for pattern in patterns for path in folder.rglob(pattern)}

    package = unpacked / "imfvla"
    modules = {path for path in files(package, "*.py") if path.parts[0] not in ("conf", "experiments")}
    assert modules == files(ROOT / "imfvla", "*.py")
    assert files(package / "conf", "*.*") == files(ROOT / "conf", "*.yaml")
    assert files(package / "experiments", "*.*") == {
        Path("tables.yaml"), *(Path("paper", f"{name}.csv") for name in ("published", "table1", "table2", "table3"))
    }  # fmt: skip
    assert files(package / "reporting", "page.*") == files(ROOT / "imfvla" / "reporting", "page.*")
    assert {path.name.partition("-")[0] for path in unpacked.iterdir()} == {"imfvla"}


def test_every_command_is_a_script(unpacked):
    text = next(unpacked.glob("*.dist-info/entry_points.txt")).read_text()
    for name in ("bench", "collect", "compare", "convert", "evaluate", "gallery", "report", "train"):
        assert f"imfvla-{name} = imfvla.scripts:{name}\n" in text


def test_it_composes_its_own_configs_from_anywhere(unpacked, tmp_path):
    (tmp_path / "conf").mkdir()  # somebody else's
    done = run(unpacked, tmp_path, "-c", COMPOSE)
    assert done.returncode == 0, done.stderr
    file, name, rows, command = json.loads(done.stdout)
    assert Path(file).is_relative_to(unpacked)
    assert (name, rows > 18) == ("transfer_dwell", True)
    assert command == "pip install 'imfvla[slurm]'"


@pytest.mark.parametrize("by", [["--config-dir", "mine"], ["hydra.searchpath=[file://mine]"]])
def test_the_script_of_a_command_takes_configs_of_ones_own(unpacked, tmp_path, by):
    experiment = tmp_path / "mine" / "exp" / "own.yaml"
    experiment.parent.mkdir(parents=True)
    experiment.write_text("# @package _global_\nname: own\n")
    script = "import imfvla.scripts; imfvla.scripts.train()"
    done = run(unpacked, tmp_path, "-c", script, "+exp=own", "--cfg", "job", *by)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("name: own\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_data_set_of_lerobot_is_trained_on_judged_and_written_back(unpacked, tmp_path):
    """What docs/data.md shows, in an empty directory."""
    pytest.importorskip("pyarrow", reason="needs the extra lerobot")
    from outside import ROBOT, episode, options

    from imfvla.sources.lerobot import LeRobotWriter, open_source

    with LeRobotWriter(tmp_path / "arm", ROBOT, pictures="png") as writer:
        for number in range(3):
            writer.add(episode(number))
    train = "import imfvla.scripts; imfvla.scripts.train()"
    data = ["task=none", "demos=lerobot", "demos.path=arm", "name=mine"]
    done = run(unpacked, tmp_path, "-c", train, *data, "task.held_out=1", *TINY)
    assert done.returncode == 0, done.stderr
    (table,) = tmp_path.glob("runs/mine/*/offline.md")
    assert "shoulder" in table.read_text(encoding="utf-8")
    convert = "import imfvla.scripts; imfvla.scripts.convert()"
    ways = ["from=lerobot", "from.path=arm", "to=lerobot", "to.path=back", "to.pictures=png"]
    done = run(unpacked, tmp_path, "-c", convert, *ways)
    assert (done.returncode, done.stdout) == (0, "back: 3 episodes, 24 steps.\n"), done.stderr
    source = open_source(options("lerobot", path=str(tmp_path / "back")))
    assert source.robot == ROBOT
    for number in range(3):
        read, made = source.episode(number, ("front", "wrist")), episode(number)
        assert (read.action == made.action).all()
        assert all((read.images[view] == frames).all() for view, frames in made.images.items())


def test_its_results_name_no_commit_of_the_project_that_it_is_installed_in(unpacked, tmp_path):
    commit = [
        "-c",
        "user.name=a",
        "-c",
        "user.email=a",
        "commit",
        "--quiet",
        "--allow-empty",
        "-m",
        "of another project",
    ]
    for arguments in (["init", "--quiet"], commit):
        subprocess.run(["git", "-C", str(unpacked.parent), *arguments], check=True)
    script = (
        "import json; from imfvla.storage.fingerprint import code_version; print(json.dumps(code_version()))"
    )
    version = json.loads(run(unpacked, tmp_path, "-c", script).stdout)
    assert (version["commit"], version["dirty"]) == (None, None)


def test_a_report_of_an_empty_directory_says_what_to_do(unpacked, tmp_path):
    done = run(unpacked, tmp_path, "-m", "imfvla.report")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("No run with a finished evaluation below experiments/pretrained, ")
    assert list(tmp_path.iterdir()) == []
