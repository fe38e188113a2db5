"""Chooses how MuJoCo draws without a screen; must run before mujoco is imported."""

import ctypes
import os
import threading
from collections.abc import Callable

from imfvla.errors import UserError

BACKENDS = ("egl", "osmesa", "glfw", "cgl", "wgl")
PROBE_TIMEOUT_S = 20.0  # a driver answers within a second, or never
_REMEDY = (
    "install one of them, on Debian or Ubuntu: `sudo apt-get install -y libegl1 libgl1-mesa-dri` "
    "(EGL) or `sudo apt-get install -y libosmesa6` (OSMesa)"
)


def select_gl_backend() -> str:
    """Sets MUJOCO_GL, PYOPENGL_PLATFORM and LP_NUM_THREADS for this process and returns the backend's name.

    A MUJOCO_GL that is already set is honoured; otherwise EGL is taken where a device answers, else OSMesa.
    Software rendering gains nothing from threads at these image sizes, so llvmpipe gets none.

    Raises:
        UserError: no backend can be loaded, or MUJOCO_GL names an unknown one.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted and wanted not in BACKENDS:
        raise UserError(
            f"MUJOCO_GL must be one of {', '.join(BACKENDS)}, found {wanted!r}; unset it or mend it."
        )
    if wanted in _PROBES and not _answers(_PROBES[wanted]):
        raise UserError(f"MUJOCO_GL={wanted} was asked for, but {wanted} cannot be loaded here; {_REMEDY}.")
    backend = wanted or next((name for name, probe in _PROBES.items() if _answers(probe)), None)
    if backend is None:
        raise UserError(
            f"MuJoCo needs EGL or OSMesa to render the cameras, but neither can be loaded; {_REMEDY}."
        )
    os.environ["MUJOCO_GL"] = backend
    if backend in _PROBES:
        os.environ["PYOPENGL_PLATFORM"] = backend
    os.environ.setdefault("LP_NUM_THREADS", "0")
    return backend


def _answers(probe: Callable[[], bool]) -> bool:
    """Whether `probe` finds its backend in time; a driver that hangs is one that is not there."""
    found: list[bool] = []
    thread = threading.Thread(target=lambda: found.append(probe()), daemon=True)
    thread.start()
    thread.join(PROBE_TIMEOUT_S)
    return found == [True]


def _has_egl() -> bool:
    """Whether libEGL loads and knows at least one device."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    if not address:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))(
        address
    )
    count = ctypes.c_int(0)
    return bool(query(0, None, ctypes.byref(count))) and count.value > 0


def _has_osmesa() -> bool:
    """Whether one of the OSMesa libraries loads."""
    for name in ("libOSMesa.so", "libOSMesa.so.8", "libOSMesa.so.6"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


_PROBES = {"egl": _has_egl, "osmesa": _has_osmesa}
