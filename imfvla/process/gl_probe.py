"""Whether a GL backend can draw: `python gl_probe.py egl` prints {"devices": ..., "problem": null or a text} as JSON.

A program of its own that knows nothing of imfvla: PyOpenGL binds a process to one backend, and a driver that hangs or
crashes must not take the caller with it. It does what dm_control and PyOpenGL do: the same libraries, the first
device that initialises, the same framebuffer.
"""

import ctypes
import json
import os
import sys
from collections.abc import Iterable
from ctypes import CFUNCTYPE, POINTER, byref, c_int, c_uint, c_void_p

MAX_DEVICES = 10  # as many as dm_control asks for
EGL_PLATFORM_DEVICE_EXT, EGL_OPENGL_API = 0x313F, 0x30A2
# 8 bits of red, green, blue and alpha, 24 of depth, 8 of stencil; RGB, pbuffer surface, desktop OpenGL; end.
EGL_ATTRIBUTES = (
    *(0x3024, 8, 0x3023, 8, 0x3022, 8, 0x3021, 8, 0x3025, 24, 0x3026, 8),
    *(0x303F, 0x308E, 0x3033, 0x0001, 0x3040, 0x0008, 0x3038),
)
GL_RENDERER, GL_FLOAT, OSMESA_RGBA = 0x1F01, 0x1406, 0x1908


class CannotDraw(Exception):
    """Why not; `devices` is how many EGL devices there are."""

    def __init__(self, problem: str, devices: int = 0) -> None:
        super().__init__(problem)
        self.devices = devices


def load(*names: str) -> ctypes.CDLL:
    """The first library that loads, of those that PyOpenGL tries: with and without a version."""
    for file in (f"lib{name}.so{version}" for name in names for version in ("", ".8", ".6", ".1", ".0")):
        try:
            return ctypes.CDLL(file, ctypes.RTLD_GLOBAL)
        except OSError:
            continue
    raise CannotDraw(f"lib{' or lib'.join(names)} cannot be loaded")


def function(library: ctypes.CDLL, name: str, result: type | None, *arguments: type):
    found = getattr(library, name)
    found.restype, found.argtypes = result, arguments
    return found


def check_egl() -> int:
    """Makes a context current on a device and asks for the renderer; returns the number of devices."""
    egl = load("EGL")
    find = function(egl, "eglGetProcAddress", c_void_p, ctypes.c_char_p)
    query_address, display_address = find(b"eglQueryDevicesEXT"), find(b"eglGetPlatformDisplayEXT")
    if not (query_address and display_address):
        raise CannotDraw("libEGL cannot draw without a screen")
    query = CFUNCTYPE(c_uint, c_int, POINTER(c_void_p), POINTER(c_int))(query_address)
    found, count = (c_void_p * MAX_DEVICES)(), c_int(0)
    if not query(MAX_DEVICES, found, byref(count)) or count.value < 1:
        raise CannotDraw("EGL has no device")
    devices = found[: count.value]
    chosen = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    candidates = devices if chosen is None else devices[int(chosen) :][:1]
    platform_display = CFUNCTYPE(c_void_p, c_uint, c_void_p, c_void_p)(display_address)
    try:
        _draw_with_egl(
            egl, [platform_display(EGL_PLATFORM_DEVICE_EXT, device, None) for device in candidates]
        )
    except CannotDraw as error:
        raise CannotDraw(str(error), devices=len(devices)) from None
    return len(devices)


def _draw_with_egl(egl: ctypes.CDLL, displays: Iterable[int | None]) -> None:
    initialise = function(egl, "eglInitialize", c_uint, c_void_p, c_void_p, c_void_p)
    display = next((display for display in displays if display and initialise(display, None, None)), None)
    if display is None:
        raise CannotDraw("no EGL device initialises")
    gl = load("OpenGL", "GL")
    choose = function(
        egl, "eglChooseConfig", c_uint, c_void_p, c_void_p, POINTER(c_void_p), c_int, POINTER(c_int)
    )
    attributes, config, count = (c_int * len(EGL_ATTRIBUTES))(*EGL_ATTRIBUTES), c_void_p(), c_int(0)
    if not choose(display, attributes, byref(config), 1, byref(count)) or count.value < 1:
        raise CannotDraw("EGL has no framebuffer with colour, depth and stencil")
    create = function(egl, "eglCreateContext", c_void_p, c_void_p, c_void_p, c_void_p, c_void_p)
    make_current = function(egl, "eglMakeCurrent", c_uint, c_void_p, c_void_p, c_void_p, c_void_p)
    function(egl, "eglBindAPI", c_uint, c_uint)(EGL_OPENGL_API)
    context = create(display, config, None, None)
    if not (context and make_current(display, None, None, context)):
        raise CannotDraw("EGL makes no OpenGL context")
    _ask_renderer(gl)


def check_osmesa() -> int:
    """Makes a context current on an off-screen buffer and asks for the renderer; there are no devices to count."""
    osmesa = load("OSMesa")
    create = function(osmesa, "OSMesaCreateContextExt", c_void_p, c_uint, c_int, c_int, c_int, c_void_p)
    make_current = function(osmesa, "OSMesaMakeCurrent", c_uint, c_void_p, c_void_p, c_uint, c_int, c_int)
    context = create(OSMESA_RGBA, 24, 8, 0, None)
    if not (context and make_current(context, (ctypes.c_float * (4 * 8 * 8))(), GL_FLOAT, 8, 8)):
        raise CannotDraw("OSMesa makes no OpenGL context")
    _ask_renderer(osmesa)
    return 0


def _ask_renderer(gl: ctypes.CDLL) -> None:
    if not function(gl, "glGetString", ctypes.c_char_p, c_uint)(GL_RENDERER):
        raise CannotDraw("OpenGL does not answer")


CHECKS = {"egl": check_egl, "osmesa": check_osmesa}

if __name__ == "__main__":
    try:
        answer = {"devices": CHECKS[sys.argv[1]](), "problem": None}
    except CannotDraw as error:
        answer = {"devices": error.devices, "problem": str(error)}
    print(json.dumps(answer), flush=True)
    os._exit(0)  # some drivers crash while they unload
