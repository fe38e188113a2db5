"""`torch.compile` of the parts of a policy in which training steps and predictions spend their time.

Encoder, context and core are compiled apart, so that the same code serves every generator and any number of
evaluations. Forward-mode differentiation goes through the core as it is written (`forward_mode.jvp`): compiled code
would drop the tangents.
"""

import os
import shutil
import warnings

import torch
from torch import nn

from imfvla.errors import UserError


def has_compiler() -> bool:
    """Whether inductor finds a C++ compiler."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "g++", "clang++"))


def compile_parts(policy: nn.Module, backend: str = "inductor") -> None:
    """Compiles encoder and core of `policy` in place, at the first call for each shape; weights keep their names.

    A compiled policy computes what it computed before but for rounding (1e-4 of an action's deviation).

    Raises UserError where the C++ compiler that inductor needs is missing.
    """
    if backend == "inductor" and not has_compiler():
        raise UserError(
            "compile=true needs a C++ compiler, none found: install g++ or leave policies uncompiled."
        )
    warnings.filterwarnings("ignore", "`torch.jit.script_method` is deprecated")  # PyTorch's own use of it
    policy.encoder.compile(backend=backend, dynamic=False)
    policy.core.compile(backend=backend, dynamic=False)
    policy.core.condition = torch.compile(policy.core.condition, backend=backend, dynamic=False)
