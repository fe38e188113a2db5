"""What a result depends on besides its config: machine, packages and code. Recorded with every run."""

import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

import imfvla
from imfvla.config import components
from imfvla.storage.code_changes import changes_since_commit, commit_of

CPU_FLAGS = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_bf16", "amx_tile")
SHORT = 12  # characters of a commit in messages
PACKAGES = (
    "torch",
    "numpy",
    "mujoco",
    "dm-control",
    "hydra-core",
    "safetensors",
    "opencv-python-headless",
    "mcap",
    "av",
)


def fingerprint(**extra: Any) -> dict[str, Any]:
    """Machine, packages and code as JSON-able values; `extra` (threads, GL renderer) is added."""
    return {"code": code_version(), "machine": machine(), "packages": packages(), **extra}


@cache
def code_version() -> dict[str, Any]:
    """Version, commit, whether files differ from it (dirty), and a digest of those that do (changes).

    New files count, kept results do not: see `imfvla.storage.code_changes`. Outside a clone only the version is known.
    """
    root = Path(imfvla.__file__).resolve().parents[1]
    # From a wheel the environment itself may lie in the repository of another project.
    commit = commit_of(root) if (root / ".git").exists() else None
    changes = changes_since_commit(root) if commit else None
    return {
        "version": imfvla.__version__,
        "commit": commit,
        "dirty": None if changes is None else bool(changes),
        "changes": changes or None,
    }


def describe_code(code: Any) -> str:
    """A code version in a few words: commit, and which changes to it."""
    if not isinstance(code, Mapping):
        return "unknown"
    commit = str(code.get("commit") or f"version {code.get('version')}")[:SHORT]
    return f"{commit} with changes {code.get('changes') or 'unknown'}" if code.get("dirty") else commit


@cache
def machine() -> dict[str, Any]:
    """CPU model, the flags that matter for speed, cores, memory and system."""
    model, flags = platform.processor() or platform.machine(), set()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                model = value.strip()
            elif key.strip() == "flags":
                flags = set(value.split())
    return {
        "cpu": model,
        "cpu_flags": [flag for flag in CPU_FLAGS if flag in flags],
        "physical_cores": physical_cores(),
        "logical_cores": os.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


@cache
def packages() -> dict[str, str]:
    """Installed versions of the packages that results depend on, and of those that register components."""
    installed = {
        dist.metadata["Name"].lower(): dist.version
        for dist in metadata.distributions()
        if dist.metadata["Name"]
    }
    return {name: installed[name] for name in PACKAGES if name in installed} | components.packages()


def physical_cores() -> int:
    """Physical cores that this process may use; hyper-threads are not counted twice."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(psutil.cpu_count(logical=False) or allowed, allowed))
