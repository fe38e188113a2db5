import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from imfvla.errors import UserError
from imfvla.process import gl, gl_probe
from imfvla.process.gl import Probed

ROOT = Path(__file__).resolve().parents[2]
DRAWS, MISSING = Probed(devices=1), Probed(problem="its library cannot be loaded")


@pytest.fixture
def clean(monkeypatch):
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "LP_NUM_THREADS", "MUJOCO_EGL_DEVICE_ID"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    return monkeypatch


def answers(clean, egl: Probed, osmesa: Probed) -> None:
    clean.setattr(gl, "_probe", {"egl": egl, "osmesa": osmesa}.__getitem__)


@pytest.mark.parametrize(
    ("egl", "osmesa", "backend"), [(DRAWS, DRAWS, "egl"), (MISSING, DRAWS, "osmesa"), (DRAWS, MISSING, "egl")]
)
def test_what_draws_is_chosen(clean, egl, osmesa, backend):
    answers(clean, egl, osmesa)
    assert gl.select_gl_backend() == backend
    assert os.environ["MUJOCO_GL"] == os.environ["PYOPENGL_PLATFORM"] == backend
    assert os.environ["LP_NUM_THREADS"] == "0"


def test_a_choice_of_the_user_is_honoured(clean):
    answers(clean, DRAWS, DRAWS)
    clean.setenv("MUJOCO_GL", "OSMesa")
    clean.setenv("LP_NUM_THREADS", "2")
    assert gl.select_gl_backend() == "osmesa"
    assert os.environ["LP_NUM_THREADS"] == "2"


def test_without_any_backend_the_packages_to_install_are_named(clean):
    answers(clean, MISSING, MISSING)
    with pytest.raises(
        UserError, match=r"neither draws here \(egl: its.*apt-get install .*libegl1 .*libopengl0"
    ):
        gl.select_gl_backend()
    assert "MUJOCO_GL" not in os.environ


def test_a_chosen_backend_that_does_not_draw_is_named(clean):
    answers(clean, DRAWS, MISSING)
    clean.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match=r"MUJOCO_GL=osmesa was asked for.*libosmesa6"):
        gl.select_gl_backend()


def test_an_unknown_backend_is_named(clean):
    clean.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(gl.WrongSetting, match=r"MUJOCO_GL must be one of egl, osmesa.*found 'vulkan'"):
        gl.select_gl_backend()


@pytest.mark.parametrize(
    ("device", "answer", "words"),
    [
        ("GPU-1234", DRAWS, "must be the number of an EGL device, found 'GPU-1234'"),
        ("-1", DRAWS, "found '-1'"),
        ("7", Probed(devices=2, problem="no EGL device initialises"), r"in 0 \.\.\. 1, .* found '7'"),
        ("1", Probed(devices=2, problem="no EGL device initialises"), "=1 does not draw .no EGL device"),
    ],
)
def test_a_device_that_is_not_there_is_named_and_osmesa_not_taken_for_it(clean, device, answer, words):
    answers(clean, answer, DRAWS)
    clean.setenv("MUJOCO_EGL_DEVICE_ID", device)
    with pytest.raises(gl.WrongSetting, match=f"MUJOCO_EGL_DEVICE_ID.*{words}.*unset it"):
        gl.select_gl_backend()


def test_a_device_matters_to_egl_alone(clean):
    answers(clean, MISSING, DRAWS)
    clean.setenv("MUJOCO_EGL_DEVICE_ID", "7")
    assert gl.select_gl_backend() == "osmesa"
    clean.setenv("MUJOCO_EGL_DEVICE_ID", "GPU-1234")
    clean.setenv("MUJOCO_GL", "osmesa")
    assert gl.select_gl_backend() == "osmesa"


def test_an_empty_device_is_none(clean):
    answers(clean, DRAWS, MISSING)
    clean.setenv("MUJOCO_EGL_DEVICE_ID", "")
    gl.select_gl_backend()
    assert "MUJOCO_EGL_DEVICE_ID" not in os.environ  # which dm_control would not read as a number


@pytest.mark.parametrize(
    ("script", "words"),
    [("exec sleep 60", "no answer within"), (f"kill -{signal.SIGSEGV:d} $$", "driver died")],
)
def test_a_driver_that_hangs_or_dies_does_not_draw(monkeypatch, tmp_path, script, words):
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(gl, "PROBE_TIMEOUT_S", 0.2)
    assert words in gl._probe("egl").problem


def test_the_backend_of_these_tests_draws_by_the_probe_too():
    from imfvla import tasks  # noqa: F401 - chooses it

    assert gl._probe(os.environ["MUJOCO_GL"]).problem is None


def test_egl_without_the_library_of_opengl_does_not_draw(monkeypatch):
    real = gl_probe.load

    def without_opengl(*names):
        if "OpenGL" in names:
            raise gl_probe.CannotDraw("libOpenGL or libGL cannot be loaded")
        return real(*names)

    monkeypatch.setattr(gl_probe, "load", without_opengl)
    with pytest.raises(gl_probe.CannotDraw, match=r"libOpenGL|libEGL"):
        gl_probe.check_egl()


@pytest.mark.parametrize(
    "command",
    [
        ["-m", "imfvla.collect", "task=socket", "episodes=1", "workers=0"],
        ["-m", "imfvla.gallery", "task=socket"],
        [str(ROOT / "tools" / "doctor.py"), "--only", "gl"],
    ],
)
def test_a_wrong_device_is_reported_in_one_sentence(tmp_path, command):
    wrong = {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "GPU-1234", "PYTHONPATH": str(ROOT)}
    entry = subprocess.run(
        [sys.executable, *command], env=os.environ | wrong, cwd=tmp_path, capture_output=True, text=True
    )
    assert entry.returncode == 2
    assert re.fullmatch("MUJOCO_EGL_DEVICE_ID must be the number of an EGL device.*\n", entry.stderr)
    assert not list(tmp_path.rglob("*.mcap"))


def test_the_readme_names_the_packages_that_the_installer_takes():
    readme = (ROOT / "README.md").read_text()
    assert f"`{gl.install_command()}`" in readme
    assert f"`{' '.join(gl.PACKAGES['osmesa'])}`" in readme
