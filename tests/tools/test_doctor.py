"""tools/doctor.py and tools/install_gl.sh: what they find, what they say, and that a hanging driver ends."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from imfvla.process.gl import PACKAGES, install_command

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def doctor():
    spec = importlib.util.spec_from_file_location("doctor", TOOLS / "doctor.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["doctor"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["doctor"]


def fake_program(folder: Path, name: str, script: str) -> Path:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_a_frame_is_rendered_and_named_by_its_digest(doctor):
    finding = doctor.check_gl()
    assert finding.remedy is None, finding
    assert re.search(r"frame [0-9a-f]{12} in", finding.text)


def test_a_driver_that_hangs_is_stopped_and_reported(doctor, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(fake_program(tmp_path, "python", "exec sleep 60")))
    finding = doctor.check_gl(timeout_s=0.1)
    assert "hangs" in finding.text
    assert "apt-get install" in finding.remedy


def test_a_backend_that_fails_is_answered_with_one_that_renders(doctor, monkeypatch):
    def only_osmesa(environment, timeout_s):
        if environment.get("MUJOCO_GL") == "osmesa":
            return {"has_content": True}, ""
        return None, "no frame could be rendered: no EGL device"

    monkeypatch.setattr(doctor, "_render_in_child", only_osmesa)
    finding = doctor.check_gl()
    assert "no EGL device; osmesa renders" in finding.text
    assert finding.remedy == "export MUJOCO_GL=osmesa"


def test_a_blank_frame_is_a_failure(doctor, monkeypatch):
    blank = {"backend": "egl", "renderer": "x", "digest": "0" * 12, "seconds": 1.0, "has_content": False}
    monkeypatch.setattr(doctor, "_render_in_child", lambda environment, timeout_s: (blank, ""))
    finding = doctor.check_gl()
    assert "blank" in finding.text
    assert finding.remedy is not None


def test_packages_are_compared_with_their_pins(doctor, tmp_path):
    pins = tmp_path / "constraints.txt"
    pins.write_text("# a comment\nnumpy==0.1\nno-such-package==1.0\npytest==" + pytest.__version__ + "\n")
    finding = doctor.check_packages(pins)
    assert "no-such-package is missing" in finding.text
    assert "(wanted 0.1)" in finding.text
    assert "pytest" not in finding.text
    assert "make setup" in finding.remedy


def test_a_local_version_satisfies_its_pin(doctor, monkeypatch, tmp_path):
    pins = tmp_path / "constraints.txt"
    pins.write_text("torch==2.13.0\n")
    monkeypatch.setattr(doctor.metadata, "version", lambda name: "2.13.0+cpu")
    assert doctor.check_packages(pins).remedy is None


def test_a_folder_that_cannot_be_written_fails(doctor, tmp_path):
    finding = doctor.check_disk(tmp_path / "nowhere")
    assert "cannot be written" in finding.text
    assert finding.remedy is not None


def test_a_full_disk_fails(doctor, monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "MIN_FREE_GB", 1e9)
    finding = doctor.check_disk(tmp_path)
    assert "GB free" in finding.text
    assert finding.remedy.startswith("free ")


@pytest.mark.parametrize(("remedy", "code"), [(None, 0), ("do this", 1)])
def test_the_exit_code_and_the_remedy_follow_the_findings(doctor, monkeypatch, capsys, remedy, code):
    monkeypatch.setattr(doctor, "CHECKS", {"disk": lambda: doctor.Finding("disk", "as found", remedy)})
    assert doctor.main([]) == code
    printed = capsys.readouterr().out
    assert "as found" in printed
    assert ("remedy: do this" in printed) == (remedy is not None)


def test_a_package_that_does_not_import_is_a_finding(doctor, monkeypatch):
    def broken():
        import no_such_package  # noqa: F401

    monkeypatch.setitem(doctor.CHECKS, "video", broken)
    finding = doctor.run_check("video")
    assert "no_such_package" in finding.text
    assert "make setup" in finding.remedy


@pytest.mark.parametrize("name", ["python", "machine", "threads", "video"])
def test_the_other_checks_describe_this_machine(doctor, name):
    finding = doctor.CHECKS[name]()
    assert finding.name == name
    assert finding.remedy is None, finding


def test_without_rights_the_installer_prints_the_one_command_and_fails(tmp_path):
    fake_program(tmp_path, "id", "echo 1000")
    fake_program(tmp_path, "sudo", "exit 1")
    fake_program(tmp_path, "apt-get", f"touch {tmp_path}/called")
    path = f"{tmp_path}{os.pathsep}/usr/bin{os.pathsep}/bin"
    installer = subprocess.run(
        [str(TOOLS / "install_gl.sh"), sys.executable],
        env={"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert installer.returncode == 1
    assert f"let an administrator run `{install_command()}`" in installer.stderr
    assert not (tmp_path / "called").exists()


def test_where_egl_does_not_render_the_installer_goes_over_to_osmesa(tmp_path):
    asked = tmp_path / "asked"
    fake_program(tmp_path, "id", "echo 0")
    fake_program(tmp_path, "apt-get", f'echo "$@" >> {asked}')
    renders = f"*doctor.py*) grep -q libosmesa6 {asked} ;;"  # as if EGL had no device
    python = fake_program(tmp_path, "python", f'case "$*" in {renders} *) exec {sys.executable} "$@" ;; esac')
    path = f"{tmp_path}{os.pathsep}/usr/bin{os.pathsep}/bin"
    installer = subprocess.run(
        [str(TOOLS / "install_gl.sh"), str(python)],
        env={"PATH": path},
        capture_output=True,
        text=True,
    )
    assert installer.returncode == 0, installer.stderr
    installed = [line.split("--no-upgrade ")[1].split() for line in asked.read_text().splitlines()[1:]]
    assert installed == [list(PACKAGES["egl"]), list(PACKAGES["osmesa"])]
    assert "MUJOCO_GL" not in installer.stdout + installer.stderr


@pytest.mark.parametrize(("code", "expected"), [(0, ("", 0)), (1, ("installs\n", 0)), (2, ("", 1))])
def test_make_setup_installs_only_where_an_installation_helps(code, expected):
    """The doctor's exit code 2 is a wrong environment variable."""
    recipe = re.search(r"doctor.py --only gl > /dev/null (\|\|.*)", (TOOLS.parent / "Makefile").read_text())
    command = recipe.group(1).replace("$$", "$").replace("tools/install_gl.sh $(PY)", "echo installs")
    shell = subprocess.run(["bash", "-c", f"(exit {code}) {command}"], capture_output=True, text=True)
    assert (shell.stdout, shell.returncode) == expected


@pytest.mark.parametrize(
    ("digests", "gradients", "words"),
    [
        ("aa", "xx", "repeat bit for bit here"),
        ("ab", "xx", "a and b"),
        ("aa", "xy", "training steps .* differ"),
    ],
)
def test_what_does_not_repeat_is_named_with_its_remedy(doctor, monkeypatch, digests, gradients, words):
    frames, steps = iter(digests), iter(gradients)
    monkeypatch.setattr(doctor, "_render_in_child", lambda *_: ({"digest": next(frames)}, ""))
    monkeypatch.setattr(doctor, "_training_digest", lambda: next(steps))
    finding = doctor.check_repeats()
    assert re.search(words, finding.text)
    assert (finding.remedy is None) == (digests + gradients == "aaxx")


def test_a_training_step_repeats(doctor):
    assert doctor._training_digest() == doctor._training_digest()
