"""Composes conf/ with Hydra into plain dictionaries, and says in one sentence what is wrong with it."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import imfvla
from imfvla.errors import UserError
from imfvla.options import suggestion
from imfvla.run_directory import EXECUTION_KEYS

CONFIG_DIRECTORY = Path(imfvla.__file__).resolve().parents[1] / "conf"
VERSION_BASE = "1.3"
MAX_RUN_NAME = 120


def compose(config_name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The config `conf/<config_name>.yaml` under command-line style overrides, resolved, as plain dicts.

    Raises UserError where an override, a group's choice or a key is not known.
    """
    register_resolvers()
    try:
        refuse_added_keys(config_name, overrides)
        with initialize_config_dir(config_dir=str(config_directory()), version_base=VERSION_BASE):
            return to_plain(hydra_compose(config_name, list(overrides)))
    except (HydraException, OmegaConfBaseException) as error:
        raise explain(error, config_name, overrides) from error


def to_plain(config: DictConfig) -> dict[str, Any]:
    """A resolved copy without OmegaConf types. Raises OmegaConf's errors for missing values."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    return plain


def run_name(overrides: Sequence[str]) -> str:
    """Directory name that the overrides of a command determine: "default" without any.

    Sorted `key=value` pairs joined by commas, without those that only name the run (exp, name) or say how it
    executes; characters that shells or file systems dislike become "-"; long names end with a digest.
    """
    parts = sorted({text.lstrip("+~") for text in overrides if not _is_execution_key(key_of(text))})
    joined = ",".join(parts)
    name = re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", re.sub(r"[\[\]\s]", "", joined)).strip("-.")
    if len(name) > MAX_RUN_NAME:
        name = f"{name[: MAX_RUN_NAME - 9]}-{hashlib.sha256(joined.encode()).hexdigest()[:8]}"
    return name or "default"


def plain_name(name: str) -> str:
    """`name` itself. Raises UserError where it is a path, which would lead out of the folder of all runs."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.,=+-]*", str(name)):
        raise UserError(
            f"name must consist of letters, digits and _.,=+-, found {name!r}: choose another name=..."
        )
    return str(name)


def register_resolvers() -> None:
    """Makes `run_name` and `plain_name` known to the configs, as `${plain_name:text}`. May be called again."""
    OmegaConf.register_new_resolver("plain_name", plain_name, replace=True)
    OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def refuse_added_keys(config_name: str, overrides: Sequence[str], more: Path | None = None) -> None:
    """Raises UserError for `+key=value` unless `key` is a group of `conf` or `more`: all other keys exist already."""
    roots = [CONFIG_DIRECTORY, *([more] if more else [])]
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if (
            override.is_add()
            and not key.startswith("hydra")
            and not any((root / key).is_dir() for root in roots)
        ):
            raise _unknown_key(key, config_name, overrides)


def explain(error: Exception, config_name: str, overrides: Sequence[str]) -> UserError:
    """The one sentence that names the key or group, what was found and the names that exist."""
    if isinstance(error, MissingConfigException) and error.options is not None and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.removesuffix(".yaml").rpartition("/")
        options = sorted(error.options)
        if group == "hydra/launcher":
            return UserError(
                f"Unknown launcher {choice!r}: known here are {', '.join(options)}; submitit_slurm and submitit_local "
                "come with pip install -e '.[slurm]', ray with pip install -e '.[ray]'."
            )
        return UserError(
            f"Unknown {group} {choice!r}{suggestion(choice, options)}: conf/{group} has {', '.join(options)}."
        )
    if isinstance(error, OverrideParseException):
        return UserError(
            f"Cannot read the override {error.override!r}: wanted key=value, such as training.steps=1000."
        )
    overridden = re.match(
        r"(?:Could not|Error) (?:override|append|delete|merging override)\w* '?([^\s'=]+)", str(error)
    )
    if isinstance(error, ConfigCompositionException) and overridden and "Could not override" in str(error):
        return _unknown_key(overridden.group(1).split("@")[0], config_name, overrides)
    text = " ".join(str(error.__cause__ or error).split())
    return UserError(
        f"The config conf/{config_name}.yaml with {' '.join(overrides) or 'no overrides'} is wrong: {text}"
    )


def _unknown_key(key: str, config_name: str, overrides: Sequence[str]) -> UserError:
    if (CONFIG_DIRECTORY / key).is_dir():
        given = next((text for text in overrides if key_of(text) == key), f"{key}=...")
        return UserError(f"{key} needs a plus sign: write +{given.lstrip('+')} instead of {given}.")
    node: Any = _config_of_groups(config_name, overrides)
    parts = key.replace("/", ".").split(".")
    parents: list[str] = []
    for part in parts[:-1]:
        if not isinstance(node, dict) or not isinstance(node.get(part), dict):
            break
        node = node[part]
        parents.append(part)
    names = sorted(str(name) for name in node) if isinstance(node, dict) else []
    where = f"in {'.'.join(parents)}" if parents else "at the top"
    unknown = parts[len(parents)]
    if unknown in names and len(parts) == len(parents) + 1:
        return UserError(f"{key} exists already: write {key}=... without a plus sign.")
    return UserError(f"Unknown key {key}{suggestion(unknown, names)}: {where} are {', '.join(names)}.")


def _config_of_groups(config_name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The config under only those overrides that choose groups: its keys are the ones that exist."""
    choices = [text for text in overrides if (CONFIG_DIRECTORY / key_of(text)).is_dir()]
    for trial in (choices, []):
        try:
            with initialize_config_dir(config_dir=str(config_directory()), version_base=VERSION_BASE):
                plain = OmegaConf.to_container(hydra_compose(config_name, trial), resolve=False)
        except (HydraException, OmegaConfBaseException):
            continue
        assert isinstance(plain, dict)
        return plain
    return {}


def config_directory() -> Path:
    """Where the YAML files are. Raises UserError where there are none."""
    if not CONFIG_DIRECTORY.is_dir():
        raise UserError(
            f"{CONFIG_DIRECTORY} does not exist: configs are read from the clone, installed by pip install -e ."
        )
    return CONFIG_DIRECTORY


def key_of(override: str) -> str:
    """The key or group of an override as it is written on a command line."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


def _is_execution_key(key: str) -> bool:
    is_name = key in ("exp", "name") or key.startswith(("hydra.", "hydra/"))
    return is_name or any(key == known or key.startswith(f"{known}.") for known in EXECUTION_KEYS)
