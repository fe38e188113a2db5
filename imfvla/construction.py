"""Builds what a config's `_target_` names, from a short list of packages: a stranger's config must not run code."""

import importlib
import inspect
import re
import types
from collections.abc import Mapping
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from hydra.utils import instantiate
from torch.optim import Optimizer

from imfvla.errors import UserError
from imfvla.options import convert, is_whole, require

# Whose classes a config may name. Constructors there compute; none writes a file, starts a process or evaluates text.
PACKAGES = ("imfvla.encoders", "imfvla.generators", "imfvla.nn")
OPTIMISERS = "torch.optim"
# `_args_` and `_recursive_` would change how a part is built from what its constructor says.
SPECIAL_KEYS = ("_target_", "_partial_")
MAX_DEPTH = 32
MAX_COUNT = 10**6  # of layers, channels and other counts: more could not be built in a lifetime
MAX_REASON = 200  # characters of what torch says
CHECKED = (bool, int, float, str, types.NoneType)


def construct(part: Mapping[str, Any], key: str, **handed: Any) -> Any:
    """The object that `part`, a resolved config under `key`, describes; nested parts are built first.

    Those of the `handed` values that its constructor names are given to it, such as the sizes that a robot decides.

    Raises UserError, before anything is built, where `part` states another value than the one that is handed, where a
    `_target_` is neither a class of `PACKAGES` nor an optimiser of torch, where a value violates the types of the
    constructor or their `Limit`, or where a text is an interpolation, which would read the environment. What a
    constructor raises arrives wrapped by Hydra.
    """
    if not isinstance(part, Mapping) or "_target_" not in part:
        raise UserError(f"{key} must be a mapping with a _target_, found {part!r}.")
    _refuse_foreign(part, key, 0)
    for name in handed.keys() & part.keys():
        require(
            part[name] == handed[name],
            f"{key}.{name}",
            f"{handed[name]!r}, as robot and observation have it, or left out",
            part[name],
        )
    taken = {name: value for name, value in handed.items() if name in _arguments_of(part["_target_"])}
    return instantiate(dict(part) | taken, _convert_="all")


def refuse_foreign_target(target: Any, key: str) -> None:
    """Raises UserError unless `target` is the full name of a class that a config may have built.

    A prefix is not enough: `imfvla.files.os.system` begins like one of ours and is `os.system`.
    """
    if not (isinstance(target, str) and _is_ours(target)):
        raise UserError(
            f"{key} must name a class defined in {', '.join(PACKAGES)}, or an optimiser of {OPTIMISERS}, "
            f"found {target!r}: a config from elsewhere must not choose what is run."
        )


def reason_of(error: BaseException) -> str:
    """The message of an error, without the C++ stack that torch appends."""
    return (str(error).splitlines() or [type(error).__name__])[0][:MAX_REASON]


def _arguments_of(target: str) -> set[str]:
    """The names of what the constructor of a class takes, its base classes' included."""
    module_name, _, name = target.rpartition(".")
    classes = getattr(importlib.import_module(module_name), name).__mro__[:-1]
    return {argument for cls in classes for argument in inspect.signature(cls.__init__).parameters}


def _check_arguments(part: Mapping[str, Any], key: str) -> None:
    """Raises UserError where an argument of one of our classes violates the types of its constructor."""
    module_name, _, name = part["_target_"].rpartition(".")
    hints: dict[str, Any] = {}
    # Base classes first.
    for cls in reversed(getattr(importlib.import_module(module_name), name).__mro__[:-1]):
        hints |= get_type_hints(cls.__init__, include_extras=True)
    for argument, value in part.items():
        if _is_checked(hints.get(argument)):
            convert(value, hints[argument], f"{key}.{argument}")


def _is_checked(hint: Any) -> bool:
    if get_origin(hint) is Annotated:
        return _is_checked(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return all(map(_is_checked, get_args(hint)))
    return hint in CHECKED


def _is_ours(target: str) -> bool:
    module_name, _, name = target.rpartition(".")
    if not re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+", target):
        return False
    if module_name == OPTIMISERS:
        found = getattr(importlib.import_module(OPTIMISERS), name, None)
        return inspect.isclass(found) and issubclass(found, Optimizer)
    if not any(module_name == package or module_name.startswith(f"{package}.") for package in PACKAGES):
        return False
    try:
        found = getattr(importlib.import_module(module_name), name, None)
    except ImportError:
        return False
    return inspect.isclass(found) and found.__module__ == module_name


def _refuse_foreign(value: Any, key: str, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise UserError(f"{key[:80]}... is nested deeper than {MAX_DEPTH} levels.")
    if is_whole(value):
        require(abs(value) <= MAX_COUNT, key, f"at most {MAX_COUNT}", value)
    if isinstance(value, Mapping):
        for name, item in value.items():
            where = f"{key}.{name}"
            if name == "_target_":
                refuse_foreign_target(item, where)
            elif re.fullmatch(r"_\w+_", str(name)) and name not in SPECIAL_KEYS:
                raise UserError(
                    f"{where} is not allowed: Hydra's own keys here are {', '.join(SPECIAL_KEYS)}."
                )
            else:
                _refuse_foreign(item, where, depth + 1)
        if "_target_" in value and not value["_target_"].startswith(OPTIMISERS):
            _check_arguments(value, key)
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            _refuse_foreign(item, f"{key}[{number}]", depth + 1)
    elif isinstance(value, str) and "${" in value:
        raise UserError(f"{key} must be a plain value, found the interpolation {value!r}.")
