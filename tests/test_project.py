"""What the project's files promise: pins for every dependency, documented targets, commands that exist."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {name.lower().replace("_", "-"): version for name, version in pairs}


def make_targets() -> list[str]:
    return re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1).split()


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {re.match(r"[\w.-]+", requirement).group().lower() for requirement in wanted}
    assert not names - pins().keys()


def test_pins_name_no_place_and_no_local_version():
    assert all(re.fullmatch(r"[\w.]+", version) for version in pins().values())


def test_the_makefile_documents_every_target():
    printed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for target in make_targets():
        assert re.search(rf"^  {target} +\S", printed, re.MULTILINE), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_only_what_exists(document):
    text = document.read_text()
    for module in set(re.findall(r"python -m (imfvla[\w.]*)", text)):
        assert (ROOT / (module.replace(".", "/") + ".py")).exists(), module
    for experiment in set(re.findall(r"\+exp=(\w+)", text)):
        assert (ROOT / "conf" / "exp" / f"{experiment}.yaml").exists(), experiment
    code = " ".join(re.findall(r"```.*?```|`[^`]+`", text, re.DOTALL))
    for target in set(re.findall(r"\bmake ([a-z]+)\b", code)):
        assert target in make_targets(), target
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (document.parent / link).exists(), link
