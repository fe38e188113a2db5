"""Chooses how MuJoCo renders without a screen; must run before mujoco is imported."""

import importlib.abc
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from imfvla.errors import UserError
from imfvla.process.running_time import run

SIMULATORS = ("mujoco", "dm_control")  # they read MUJOCO_GL when they are imported
BACKENDS = ("egl", "osmesa", "glfw", "cgl", "wgl")
PROBED = ("egl", "osmesa")  # in the order of preference
PROBE_TIMEOUT_S = 30.0  # a driver answers within a second, or never
DEVICE_KEY = "MUJOCO_EGL_DEVICE_ID"
# Debian's and Ubuntu's packages, for the installer, the messages and the README. EGL comes without the library that
# has OpenGL's functions, which is libopengl0.
PACKAGES = {
    "egl": ("libegl1", "libegl-mesa0", "libgl1-mesa-dri", "libopengl0"),
    "osmesa": ("libosmesa6",),
}


class WrongSetting(UserError):
    """An environment variable asks for something that does not exist; no package helps."""


@dataclass(frozen=True, slots=True)
class Probed:
    """What `gl_probe` found: `problem` is None where the backend draws."""

    devices: int = 0
    problem: str | None = None


def install_command(backend: str = "egl") -> str:
    """The shell command that installs the libraries of `backend` on Debian and Ubuntu."""
    packages = " ".join(PACKAGES[backend])
    return f"sudo apt-get update && sudo apt-get install -y --no-install-recommends {packages}"


def select_gl_backend() -> str:
    """Sets MUJOCO_GL, PYOPENGL_PLATFORM and LP_NUM_THREADS for this process and returns the backend's name.

    A MUJOCO_GL that is already set is honoured; otherwise EGL is taken where it draws, else OSMesa.
    Software rendering gains nothing from threads at these image sizes, so llvmpipe uses none.

    Raises:
        WrongSetting: MUJOCO_GL or MUJOCO_EGL_DEVICE_ID names no backend or device.
        UserError: no backend draws.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted and wanted not in BACKENDS:
        raise WrongSetting(
            f"MUJOCO_GL must be one of {', '.join(BACKENDS)}, found {wanted!r}; unset it or choose one of them."
        )
    backend = (
        wanted if wanted and wanted not in PROBED else _first_that_draws((wanted,) if wanted else PROBED)
    )
    os.environ["MUJOCO_GL"] = backend
    if backend in PROBED:
        os.environ["PYOPENGL_PLATFORM"] = backend
    os.environ.setdefault("LP_NUM_THREADS", "0")
    return backend


class _BeforeSimulators(importlib.abc.MetaPathFinder):
    """Finds no module; it only notices that a simulator is about to be imported."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: object = None) -> None:
        if fullname in SIMULATORS:
            select_gl_backend()
            sys.meta_path.remove(self)


def select_before_simulators() -> None:
    """Has `select_gl_backend` called when mujoco or dm_control is first imported, and not before.

    So that what only asks about tasks, such as a table or a training without rendering, needs no OpenGL.
    """
    if not any(isinstance(finder, _BeforeSimulators) for finder in sys.meta_path):
        sys.meta_path.insert(0, _BeforeSimulators())


def _first_that_draws(candidates: tuple[str, ...]) -> str:
    problems = []
    for backend in candidates:
        answer = _egl() if backend == "egl" else _probe(backend)
        if answer.problem is None:
            return backend
        problems.append(f"{backend}: {answer.problem}")
    if len(candidates) == 1:
        found = f"MUJOCO_GL={candidates[0]} was asked for, but does not draw here"
    else:
        found = "MuJoCo needs EGL or OSMesa to render the cameras, but neither draws here"
    remedy = f"on Debian or Ubuntu, run `{install_command(candidates[0])}`"
    raise UserError(f"{found} ({'; '.join(problems)}); {remedy}.")


def _egl() -> Probed:
    """The answer of EGL on the device that MUJOCO_EGL_DEVICE_ID names, if any."""
    device = os.environ.get(DEVICE_KEY)
    if device is not None and not device.strip():
        del os.environ[DEVICE_KEY]
        device = None
    if device is None:
        return _probe("egl")
    if not device.strip().isdecimal():
        raise WrongSetting(f"{DEVICE_KEY} must be the number of an EGL device, found {device!r}; unset it.")
    answer = _probe("egl")
    if answer.devices and int(device) >= answer.devices:
        raise WrongSetting(
            f"{DEVICE_KEY} must be in 0 ... {answer.devices - 1}, the EGL devices here, found {device!r}; unset it."
        )
    if answer.devices and answer.problem:
        raise WrongSetting(
            f"{DEVICE_KEY}={device} does not draw ({answer.problem}); unset it or choose another."
        )
    return answer


def _probe(backend: str) -> Probed:
    """Asks `gl_probe` in a process of its own; one that hangs or dies has a backend that does not draw."""
    program = Path(__file__).with_name("gl_probe.py")
    try:
        child = run([sys.executable, "-I", str(program), backend], PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return Probed(problem=f"no answer within {PROBE_TIMEOUT_S:g} s")
    if child.returncode != 0:
        return Probed(problem=f"its driver died with exit code {child.returncode}")
    return Probed(**json.loads(child.stdout.splitlines()[-1]))
