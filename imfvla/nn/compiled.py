"""`torch.compile` of a policy: of the parts in which training steps and predictions spend their time.

Context and core are compiled apart, so that the same code serves every generator and any number of evaluations. A
generator whose loss has a derivative has it in `velocities`, which is compiled with the core in it. The encoder stays
as it is written: compiled, its convolutions save a hundredth of a step and take a fifth of the time.

A GPU is given the whole loss as one graph, since there the time between kernels counts.
"""

import logging
import os
import shutil
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.errors import UserError

CACHE = "TORCHINDUCTOR_CACHE_DIR"  # of inductor: what it has compiled, which later processes take from there
log = logging.getLogger(__name__)


def has_compiler() -> bool:
    """Whether inductor finds a C++ compiler."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "g++", "clang++"))


def compile_parts(policy: nn.Module, backend: str = "inductor") -> bool:
    """Compiles the core of `policy` in place, at the first call for each shape; weights keep their names.

    A compiled policy computes what it computed before but for rounding (1e-4 of an action's deviation). Without the
    C++ compiler that inductor needs it stays as it is, which a line of the log says. Returns whether it compiles.
    """
    if not _is_ready(backend):
        return False
    policy.core.compile(backend=backend, dynamic=False)
    for part, name in (
        (policy.core, "condition"),
        (policy.core, "instant"),
        (policy.generator, "velocities"),
    ):
        if hasattr(part, name):
            setattr(part, name, torch.compile(getattr(part, name), backend=backend, dynamic=False))
    return True


def compile_loss(policy: nn.Module, backend: str = "inductor") -> bool:
    """Compiles the loss of `policy` in place as one graph, which draws its random numbers from an `OwnStream`.

    They are those of the code as it is written. The rest as in `compile_parts`. The compiled loss raises UserError
    where it does what cannot be in a graph.
    """
    if not _is_ready(backend):
        return False
    from torch._dynamo.exc import Unsupported  # here, since they take a second
    from torch._inductor import config

    config.fallback_random = True
    compiled = torch.compile(policy.loss, backend=backend, fullgraph=True, dynamic=False)

    def loss(batch: Any, rng: Stream) -> tuple[Tensor, dict[str, Tensor]]:
        try:
            return compiled(batch, rng)
        except Unsupported as error:
            reason = str(error).partition("\n")[0]
            raise UserError(
                f"training.compile=true makes one graph of a loss on a GPU, which this one cannot be: {reason}. Draw "
                "random numbers by imfvla.draws.draw, read no number of a tensor, or set training.compile=false."
            ) from error

    policy.loss = loss
    return True


def _is_ready(backend: str) -> bool:
    """Prepares compiling; false, with a line of the log, where inductor cannot."""
    if backend == "inductor":
        if not has_compiler():
            log.warning(
                "no C++ compiler was found, so nothing is compiled: install g++ for training.compile=true"
            )
            return False
        from torch._inductor.runtime.cache_dir_utils import default_cache_dir  # here, since it takes a second

        if os.environ.get(CACHE, default_cache_dir()) == default_cache_dir():  # as inductor may have set it
            os.environ[CACHE] = str(cache_directory())
        log.info(
            f"compiling: the next steps take a minute or two, or seconds where {os.environ[CACHE]} has their code"
        )
    warnings.filterwarnings("ignore", "`torch.jit.script_method` is deprecated")  # PyTorch's own use of it
    return True


def cache_directory() -> Path:
    """Of compiled code, in the user's cache directory."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "imfvla" / "inductor"
