"""Builds what a config's `_target_` names: our own classes, and those that installed packages register.

A stranger's config must not choose what is run.
"""

import importlib
import inspect
import re
import types
from collections.abc import Mapping
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from hydra.errors import InstantiationException
from hydra.utils import instantiate

from imfvla.config.assets import folder, shown
from imfvla.config.components import GROUP, refuse_incomplete, registered, targets
from imfvla.errors import UserError
from imfvla.options import convert, is_whole, require

# Whose classes a config may name. Constructors there compute; none writes a file, starts a process or evaluates text.
PACKAGES = ("imfvla.encoders", "imfvla.generators", "imfvla.nn")
# `_args_` and `_recursive_` would change how a part is built from what its constructor says.
SPECIAL_KEYS = ("_target_", "_partial_")
MAX_DEPTH = 32
MAX_COUNT = 10**6  # of layers, channels and other counts: more could not be built in a lifetime
MAX_REASON = 200  # characters of what torch says
CHECKED = (bool, int, float, str, types.NoneType)


def construct(part: Mapping[str, Any], key: str, contract: type | None = None, **handed: Any) -> Any:
    """The object that `part`, a resolved config under `key`, describes; nested parts are built first.

    Those of the `handed` values that its constructor names are given to it, such as the sizes that a robot decides.

    Raises UserError, before anything is built, where `part` states another value than the one that is handed, where a
    `_target_` is not what `allowed_class` takes, where a value violates the types of the constructor or their `Limit`,
    or where a text is an interpolation, which would read the environment; then where a constructor raises, or the
    object lacks what the Protocol `contract` promises.
    """
    if not isinstance(part, Mapping) or "_target_" not in part:
        raise UserError(f"{key} must be a mapping with a _target_, found {part!r}.")
    checked = _checked(part, key, 0)
    for name in handed.keys() & part.keys():
        require(
            part[name] == handed[name],
            f"{key}.{name}",
            f"{handed[name]!r}, as robot and observation have it, or left out",
            part[name],
        )
    arguments = _arguments_of(checked["_target_"])
    taken = {name: value for name, value in handed.items() if name in arguments}
    try:
        built = instantiate(checked | taken, _convert_="all")
    except InstantiationException as error:
        reason = error.__cause__ or error
        if isinstance(reason, UserError):
            raise reason from None
        raise UserError(f"{key} cannot be built from {part['_target_']}: {reason_of(reason)}") from error
    if contract is not None:
        refuse_incomplete(built, contract, key)
    return built


def allowed_class(target: Any, key: str) -> type:
    """The class whose full name is `target`: of `PACKAGES`, or registered by an installed package.

    Raises UserError for any other. A prefix is not enough: `imfvla.storage.files.os.system` begins like one of ours
    and is `os.system`.
    """
    found = _of_ours(target) or registered(target) if isinstance(target, str) else None
    if found is None:
        raise UserError(
            f"{key} must name a class defined in {', '.join(PACKAGES)}, or one that an installed package registers "
            f"under {GROUP} (here: {', '.join(targets()) or 'none'}), found {target!r}: a config from elsewhere must "
            "not choose what is run."
        )
    return found


def reason_of(error: BaseException) -> str:
    """The message of an error, without the C++ stack that torch appends."""
    return (str(error).splitlines() or [type(error).__name__])[0][:MAX_REASON]


def _arguments_of(target: type) -> set[str]:
    """The names of what the constructor of a class takes, its base classes' included."""
    return {
        argument for cls in target.__mro__[:-1] for argument in inspect.signature(cls.__init__).parameters
    }


def _check_arguments(target: type, part: Mapping[str, Any], key: str) -> None:
    """Raises UserError where an argument of a class violates the types of its constructor."""
    hints: dict[str, Any] = {}
    # Base classes first.
    for cls in reversed(target.__mro__[:-1]):
        hints |= _hints_of(cls.__init__)
    for argument, value in part.items():
        hint = hints.get(argument)
        if _is_checked(hint):
            convert(value, hint, f"{key}.{argument}")
        elif value is None and hint not in (None, Any):  # types that are not checked, such as a function
            require(
                types.NoneType in get_args(hint),
                f"{key}.{argument}",
                f"given, as in {shown(folder('conf'))}",
                None,
            )


def _hints_of(constructor: Any) -> dict[str, Any]:
    try:
        return get_type_hints(constructor, include_extras=True)
    except Exception:  # of texts that name what another package imports only for its type checker
        found = getattr(constructor, "__annotations__", {})
        return {name: hint for name, hint in found.items() if not isinstance(hint, str)}


def _is_checked(hint: Any) -> bool:
    if get_origin(hint) is Annotated:
        return _is_checked(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return all(map(_is_checked, get_args(hint)))
    return hint in CHECKED


def _of_ours(target: str) -> type | None:
    module_name, _, name = target.rpartition(".")
    if not re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+", target):
        return None
    if not any(module_name == package or module_name.startswith(f"{package}.") for package in PACKAGES):
        return None
    try:
        found = getattr(importlib.import_module(module_name), name, None)
    except ImportError:
        return None
    return found if inspect.isclass(found) and found.__module__ == module_name else None


def _checked(value: Any, key: str, depth: int) -> Any:
    """A copy with classes in place of their names, so that no second look-up finds something else."""
    if depth > MAX_DEPTH:
        raise UserError(f"{key[:80]}... is nested deeper than {MAX_DEPTH} levels.")
    if is_whole(value):
        require(abs(value) <= MAX_COUNT, key, f"at most {MAX_COUNT}", value)
    if isinstance(value, Mapping):
        checked: dict[Any, Any] = {}
        for name, item in value.items():
            where = f"{key}.{name}"
            if name == "_target_":
                checked[name] = allowed_class(item, where)
            elif re.fullmatch(r"_\w+_", str(name)) and name not in SPECIAL_KEYS:
                raise UserError(
                    f"{where} is not allowed: Hydra's own keys here are {', '.join(SPECIAL_KEYS)}."
                )
            else:
                checked[name] = _checked(item, where, depth + 1)
        if "_target_" in value:
            _check_arguments(checked["_target_"], value, key)
        return checked
    if isinstance(value, list | tuple):
        return [_checked(item, f"{key}[{number}]", depth + 1) for number, item in enumerate(value)]
    if isinstance(value, str) and "${" in value:
        raise UserError(f"{key} must be a plain value, found the interpolation {value!r}.")
    return value
