#!/usr/bin/env python3
"""Look at this machine: can it simulate, render, train and record? Each failing line comes with its remedy.

    python tools/doctor.py                # everything; exit code 1 if a line fails
    python tools/doctor.py --only gl      # one check

An environment variable with an invalid value ends it with one sentence and exit code 2.

The frame is rendered in a separate process with a time limit, so that a graphics driver that hangs cannot hang the
doctor.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # works before the package is installed

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()


import argparse
import json
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import metadata

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # works before the package is installed, and then says what is missing

from imfvla.errors import UserError  # noqa: E402
from imfvla.process import gl  # noqa: E402

MIN_PYTHON = (3, 11)
MIN_FREE_GB = 5.0  # demonstrations, frame store and one run of a task
MIN_MEMORY_GIB = 4.0
RENDER_TIMEOUT_S = 30.0
EXIT_FAILURE, EXIT_USER_ERROR = 1, 2
REINSTALL = "touch constraints.txt && make setup"
# A floor, a ball and a light: enough for a frame that is neither blank nor the same everywhere.
SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 2"/>
    <camera name="front" pos="0 -1.2 0.8" xyaxes="1 0 0 0 0.55 0.83"/>
    <geom type="plane" size="1 1 .1" rgba=".2 .6 .3 1"/>
    <geom type="sphere" size=".2" pos="0 0 .2" rgba=".8 .2 .2 1"/>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report; `remedy` is None where all is well."""

    name: str
    text: str
    remedy: str | None = None


def check_python() -> Finding:
    """The interpreter is new enough, and is the project's own environment or one the user chose."""
    found = f"{platform.python_implementation()} {platform.python_version()} at {sys.prefix}"
    if sys.version_info < MIN_PYTHON:
        return Finding(
            "python", found, "3.11 or newer is needed: make clean, then make setup PYTHON=python3.11"
        )
    return Finding("python", found)


def check_machine() -> Finding:
    """CPU model, the flags that matter for speed, cores and memory."""
    from imfvla.storage.fingerprint import machine

    found = machine()
    flags = " ".join(found["cpu_flags"]) or "no fast vector flags"
    text = "{cpu}, {physical_cores} cores ({flags}), {memory_gib} GiB memory".format(**found, flags=flags)
    if found["memory_gib"] < MIN_MEMORY_GIB:
        return Finding("machine", text, f"training needs {MIN_MEMORY_GIB:.0f} GiB; use a larger machine")
    return Finding("machine", text)


def check_threads() -> Finding:
    """How many threads torch would use; more threads than cores make small matrices far slower."""
    import torch

    from imfvla.storage.fingerprint import physical_cores

    cores = physical_cores()
    setting = os.environ.get("OMP_NUM_THREADS", "unset")
    text = f"torch uses {torch.get_num_threads()} threads on {cores} cores (OMP_NUM_THREADS {setting})"
    if torch.cuda.is_available():
        text += f", GPU {torch.cuda.get_device_name()}"
    if torch.get_num_threads() > cores:
        return Finding("threads", text, f"export OMP_NUM_THREADS={cores}")
    return Finding("threads", text)


def check_packages(constraints: Path = ROOT / "constraints.txt") -> Finding:
    """The installed packages are those of constraints.txt; a local version (torch's +cpu) does not matter."""
    missing, other, num_pins = [], [], 0
    for line in constraints.read_text(encoding="utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        name, _, wanted = line.partition("==")
        num_pins += 1
        try:
            found = metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
            continue
        if found.partition("+")[0] != wanted:
            other.append(f"{name} {found} (wanted {wanted})")
    if missing or other:
        problems = [f"{name} is missing" for name in missing] + other
        shown = ", ".join(problems[:4]) + (f" and {len(problems) - 4} more" if len(problems) > 4 else "")
        return Finding("packages", shown, REINSTALL)
    names = ("torch", "mujoco", "dm-control", "numpy")
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    return Finding("packages", f"all {num_pins} as pinned: {versions}")


def check_gl(timeout_s: float = RENDER_TIMEOUT_S) -> Finding:
    """A frame can be rendered: the backend that imfvla chooses, its renderer and the frame's digest."""
    by_hand = f"make setup installs a GL library where it may; by hand: {gl.install_command()}"
    frame, problem = _render_in_child({}, timeout_s)
    if frame is not None:
        text = "{backend}, {renderer}, frame {digest} in {seconds:.1f} s".format(**frame)
        if not frame["has_content"]:
            return Finding("gl", f"{text} is blank", f"export MUJOCO_GL=osmesa; or {by_hand}")
        return Finding("gl", text)
    chosen = os.environ.get("MUJOCO_GL")
    for backend in gl.PROBED:
        if backend == chosen:
            continue
        frame, _ = _render_in_child({"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}, timeout_s)
        if frame is not None and frame["has_content"]:
            return Finding("gl", f"{problem}; {backend} renders", f"export MUJOCO_GL={backend}")
    return Finding("gl", problem, REINSTALL if "ModuleNotFoundError" in problem else by_hand)


def check_video() -> Finding:
    """PNG (episodes) and H.264 (videos) can be written."""
    import av
    import cv2
    import numpy as np

    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    encoded, png = cv2.imencode(".png", image)
    if not encoded or not (cv2.imdecode(png, cv2.IMREAD_COLOR) == image).all():
        return Finding("video", "PNG pixels change when written and read back", REINSTALL)
    if "libx264" not in av.codecs_available:
        return Finding("video", "PyAV has no H.264 encoder (libx264)", REINSTALL)
    return Finding("video", "PNG is lossless, H.264 encoder libx264")


def check_disk(root: Path = ROOT) -> Finding:
    """The checkout is writable and there is room for demonstrations and runs."""
    try:
        with tempfile.NamedTemporaryFile(dir=root, prefix=".doctor-", suffix=".tmp"):
            pass
    except OSError as error:
        remedy = f"make it writable (chown -R $USER {root}), or clone into a folder that you own"
        return Finding("disk", f"{root} cannot be written: {error.strerror}", remedy)
    free_gb = shutil.disk_usage(root).free / 1e9
    text = f"{root} is writable, {free_gb:.1f} GB free"
    if free_gb < MIN_FREE_GB:
        return Finding(
            "disk",
            text,
            f"free {MIN_FREE_GB:.0f} GB, e.g. delete old run directories under runs/",
        )
    return Finding("disk", text)


def check_repeats(timeout_s: float = RENDER_TIMEOUT_S) -> Finding:
    """The same work twice gives the same bits: a frame in two processes, a training step in this one."""
    import torch

    frames = [_render_in_child({}, timeout_s)[0] for _ in range(2)]
    digests = {frame["digest"] for frame in frames if frame is not None}
    steps = {_training_digest() for _ in range(2)}
    threads = torch.get_num_threads()
    if not digests:
        return Finding("repeats", "there is no frame to compare", "see the line gl")
    if len(digests) != 1:
        found = " and ".join(sorted(digests))
        return Finding("repeats", f"two renderings of one scene: {found}", "export MUJOCO_GL=osmesa")
    if len(steps) != 1:
        text = f"two equal training steps on {threads} threads differ"
        return Finding("repeats", text, "set training.threads=1")
    text = f"frames (digest {digests.pop()}) and CPU training ({threads} threads) repeat bit for bit here"
    text += "; other numbers of threads or processes, another CPU or torch change the rounding"
    if torch.cuda.is_available():
        text += "; training on this GPU (for the same bits: training.device=cpu)"
    return Finding("repeats", text)


def _training_digest() -> str:
    """Of the gradients of a small convolution and matrix product."""
    import hashlib

    import torch

    rng = torch.Generator().manual_seed(0)
    images, kernel = torch.randn(8, 3, 32, 32, generator=rng), torch.randn(16, 3, 3, 3, generator=rng)
    matrix = torch.randn(16 * 900, 64, generator=rng)
    kernel.requires_grad_(), matrix.requires_grad_()
    (torch.conv2d(images, kernel).flatten(1).relu() @ matrix).square().mean().backward()
    content = kernel.grad.numpy().tobytes() + matrix.grad.numpy().tobytes()
    return hashlib.sha256(content).hexdigest()


CHECKS: dict[str, Callable[[], Finding]] = {
    "python": check_python,
    "machine": check_machine,
    "threads": check_threads,
    "packages": check_packages,
    "gl": check_gl,
    "repeats": check_repeats,
    "video": check_video,
    "disk": check_disk,
}


def render_frame() -> dict:
    """Render one frame as the simulator does: backend, renderer, digest, seconds, whether it is blank."""
    import hashlib
    import time

    start = time.perf_counter()
    backend = gl.select_gl_backend()
    from dm_control import mujoco
    from OpenGL import GL

    physics = mujoco.Physics.from_xml_string(SCENE)
    pixels = physics.render(64, 64, camera_id="front")
    with physics.contexts.gl.make_current() as context:
        renderer = context.call(GL.glGetString, GL.GL_RENDERER)
    physics.free()
    return {
        "backend": backend,
        "renderer": renderer.decode() if renderer else "unknown renderer",
        "digest": hashlib.sha256(pixels.tobytes()).hexdigest()[:12],
        "seconds": time.perf_counter() - start,
        "has_content": bool(pixels.std() > 1.0),
    }


def _render_in_child(environment: dict[str, str], timeout_s: float) -> tuple[dict | None, str]:
    """The answer of `render_frame` in a process of its own, or None and what went wrong; raises WrongSetting."""
    command = [sys.executable, str(Path(__file__).resolve()), "--render-frame"]
    try:
        child = subprocess.run(
            command,
            env=os.environ | environment,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=timeout_s,
        )
    except subprocess.TimeoutExpired:
        return None, f"no frame within {timeout_s:.0f} s: the graphics driver hangs"
    if child.returncode == 0:
        return json.loads(child.stdout.splitlines()[-1]), ""
    if child.returncode == EXIT_USER_ERROR:
        raise gl.WrongSetting(child.stderr.strip())
    last = (child.stderr.strip().splitlines() or [f"the renderer died with code {child.returncode}"])[-1]
    return None, f"no frame could be rendered: {last}"


def run_check(name: str) -> Finding:
    """The finding of one check; a package that does not import is a finding too."""
    try:
        return CHECKS[name]()
    except ImportError as error:
        return Finding(name, f"{type(error).__name__}: {error}", REINSTALL)


@as_command
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--only", choices=CHECKS, action="append", help="run this check alone (may be repeated)"
    )
    parser.add_argument("--render-frame", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.render_frame:
        return _print_frame()
    try:
        return _report(options.only or CHECKS)
    except UserError as error:
        print(error, file=sys.stderr)
        return EXIT_USER_ERROR


def _report(names: Iterable[str]) -> int:
    """Prints the findings and returns the exit code."""
    num_failed = 0
    for name in names:
        finding = run_check(name)
        print(f"{'ok  ' if finding.remedy is None else 'FAIL'}  {finding.name:<9} {finding.text}", flush=True)
        if finding.remedy is not None:
            num_failed += 1
            print(f"      {'':<9} remedy: {finding.remedy}", flush=True)
    return EXIT_FAILURE if num_failed else 0


def _print_frame() -> int:
    """What the child of `_render_in_child` does: a frame on stdout, or why there is none on stderr."""
    try:
        print(json.dumps(render_frame()))
    except UserError as error:
        print(error, file=sys.stderr)
        return EXIT_USER_ERROR if isinstance(error, gl.WrongSetting) else EXIT_FAILURE
    return 0


if __name__ == "__main__":
    sys.exit(main())
