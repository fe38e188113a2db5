import os
import threading

import pytest

from imfvla import gl
from imfvla.errors import UserError


@pytest.fixture
def clean(monkeypatch):
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "LP_NUM_THREADS"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    return monkeypatch


def probes(egl: bool, osmesa: bool) -> dict:
    return {"egl": lambda: egl, "osmesa": lambda: osmesa}


@pytest.mark.parametrize(
    ("egl", "osmesa", "backend"), [(True, True, "egl"), (False, True, "osmesa"), (True, False, "egl")]
)
def test_what_is_there_is_chosen(clean, egl, osmesa, backend):
    clean.setattr(gl, "_PROBES", probes(egl, osmesa))
    assert gl.select_gl_backend() == backend
    assert os.environ["MUJOCO_GL"] == os.environ["PYOPENGL_PLATFORM"] == backend
    assert os.environ["LP_NUM_THREADS"] == "0"


def test_a_choice_of_the_user_is_honoured(clean):
    clean.setattr(gl, "_PROBES", probes(True, True))
    clean.setenv("MUJOCO_GL", "OSMesa")
    clean.setenv("LP_NUM_THREADS", "2")
    assert gl.select_gl_backend() == "osmesa"
    assert os.environ["LP_NUM_THREADS"] == "2"


def test_without_any_backend_the_package_to_install_is_named(clean):
    clean.setattr(gl, "_PROBES", probes(False, False))
    with pytest.raises(UserError, match=r"neither can be loaded; .*apt-get install -y libegl1"):
        gl.select_gl_backend()
    assert "MUJOCO_GL" not in os.environ


def test_a_chosen_backend_that_does_not_load_is_named(clean):
    clean.setattr(gl, "_PROBES", probes(True, False))
    clean.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match=r"MUJOCO_GL=osmesa was asked for.*libosmesa6"):
        gl.select_gl_backend()


def test_an_unknown_backend_is_named(clean):
    clean.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(UserError, match=r"MUJOCO_GL must be one of egl, osmesa.*found 'vulkan'"):
        gl.select_gl_backend()


def test_a_driver_that_hangs_is_one_that_is_not_there(clean):
    waiting = threading.Event()
    clean.setattr(gl, "PROBE_TIMEOUT_S", 0.01)
    clean.setattr(gl, "_PROBES", {"egl": waiting.wait, "osmesa": lambda: True})
    try:
        assert gl.select_gl_backend() == "osmesa"
    finally:
        waiting.set()
