"""`make setup` installs only files whose hash is known."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENTRY = re.compile(
    r"([A-Za-z0-9_.-]+)==([\w.]+)( ; python_version < \"3\.13\")?((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n"
)


def hashes_in(name: str) -> dict[str, str]:
    """Package -> version. Asserts that the file has nothing else than comments and such lines with hashes."""
    text = (ROOT / name).read_text(encoding="utf-8")
    body = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("#"))
    assert ENTRY.sub("", body) == ""
    return {match[1].lower().replace("_", "-"): match[2] for match in ENTRY.finditer(body)}


def test_every_pin_has_its_hashes():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = (line.split("==") for line in lines if not line.startswith("#"))
    assert hashes_in("hashes.txt") == {name.lower().replace("_", "-"): version for name, version in pins}


def test_what_torch_adds_has_hashes_and_is_not_pinned_elsewhere():
    added = hashes_in("hashes-cuda.txt")
    assert "nvidia-cublas" in added
    assert not added.keys() & hashes_in("hashes.txt").keys()


def test_setup_with_hashes_installs_nothing_without_one_but_what_is_here():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "BUILD := $(PIP) install --no-deps --no-build-isolation\n" in makefile
    hashed = makefile.partition("ifdef HASHES")[2].partition("else\n")[0]
    lines = re.findall(r"(?:\(PIP\) install|\(BUILD\)) (.*)", hashed)
    local = [line for line in lines if re.match(r"(-e \.|\./tools/labmaze)(;|$)", line)]
    assert len(local) == 2
    assert all("--require-hashes" in line for line in lines if line not in local)
