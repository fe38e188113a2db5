"""Composes conf/ with Hydra into plain dictionaries, and says in one sentence what is wrong with it."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imfvla.command.missing import refuse_missing
from imfvla.config.assets import folder, install_command, shown
from imfvla.environments import usual_views
from imfvla.errors import UserError
from imfvla.options import require, suggestion
from imfvla.storage.run_names import key_of, run_name

CONFIG_DIRECTORY = folder("conf")
VERSION_BASE = "1.3"
SEARCH_PATH = "hydra.searchpath"
COMMAND_LINE = "command-line"  # what Hydra calls the provider of --config-dir
_MERGED = re.compile(r"Cannot merge \w+ with \w+ full_key: (\S+) object_type=(dict|list)")
_INTERPOLATED = re.compile(r"Interpolation key '([^']+)' not found full_key: (\S+)")
_KINDS = ("a list", "a mapping of keys to values")


@dataclass(frozen=True, slots=True)
class Places:
    """Where configs are besides `conf`: the folder of --config-dir, and the override of hydra.searchpath, if any."""

    more: Path | None = None
    search_path: tuple[str, ...] = ()

    @classmethod
    def of_command(cls) -> "Places":
        """Those of the command that runs, for the configs that it composes itself."""
        if not HydraConfig.initialized():
            return cls()
        hydra = HydraConfig.get()
        given = [source.path for source in hydra.runtime.config_sources if source.provider == COMMAND_LINE]
        more = Path(given[0]).absolute() if given else None
        return cls(more, tuple(searched(hydra.overrides.hydra)))


NOWHERE_ELSE = Places()


def compose(config_name: str, overrides: Sequence[str] = (), places: Places = NOWHERE_ELSE) -> dict[str, Any]:
    """The config `conf/<config_name>.yaml` under command-line style overrides, resolved, as plain dicts.

    Raises UserError where an override, a group's choice or a key is not known.
    """
    register_resolvers()
    overrides = [*places.search_path, *overrides]
    try:
        refuse_added_keys(config_name, overrides, places.more)
        with configs(config_name, places.more):
            return to_plain(hydra_compose(config_name, overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise explain(error, config_name, overrides, places.more) from error


def choices_of(group: str, config_name: str, places: Places = NOWHERE_ELSE) -> list[str]:
    """What the group has in `conf` and in these places, by name."""
    with configs(config_name, places.more) as hydra:
        options = hydra.config_loader.get_group_options(group, None, config_name, list(places.search_path))
        return sorted(options)


def to_plain(config: DictConfig) -> dict[str, Any]:
    """A resolved copy without OmegaConf types. Raises UserError naming all mandatory values that are missing."""
    refuse_missing(config)
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    return plain


@contextmanager
def configs(config_name: str, more: Path | None = None) -> Iterator[Hydra]:
    """Hydra over `conf`, and over the folder `more` before it, as --config-dir names it."""
    with initialize_config_dir(str(config_directory()), version_base=VERSION_BASE, job_name=config_name):
        hydra = GlobalHydra.instance().hydra
        if more is not None:
            search_path = hydra.config_loader.get_search_path()
            search_path.prepend(COMMAND_LINE, f"file://{more}", SearchPathQuery(provider="schema"))
            hydra.config_loader = ConfigLoaderImpl(search_path)  # which lists its sources when it is made
        yield hydra


def plain_name(name: str) -> str:
    """`name` itself. Raises UserError where it is a path, which would lead out of the folder of all runs."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.,=+-]*", str(name)):
        raise UserError(
            f"name must consist of letters, digits and _.,=+-, found {name!r}: choose another name=..."
        )
    return str(name)


def register_resolvers() -> None:
    """Makes these functions known to the configs, as `${plain_name:text}`. May be called again."""
    OmegaConf.register_new_resolver("plain_name", plain_name, replace=True)
    OmegaConf.register_new_resolver("run_name", run_name, replace=True)
    OmegaConf.register_new_resolver("usual_views", usual_views, replace=True)


def refuse_added_keys(config_name: str, overrides: Sequence[str], more: Path | None = None) -> None:
    """Raises UserError for `+key=value` unless `key` is a group, since all other keys exist already.

    Groups are those of `conf`, of `more`, and of what hydra.searchpath names; UserError where that does not exist.
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for place in [place for override in parsed for place in _places(override)]:
        _refuse_absent(place)
    for override in parsed:
        _refuse_list_of_choices(override)
    added = [override.key_or_group for override in parsed if override.is_add()]
    unknown = [key for key in added if not key.startswith("hydra") and not (CONFIG_DIRECTORY / key).is_dir()]
    groups = _groups(unknown, config_name, overrides, more)
    for key in unknown:
        if key not in groups:
            raise _unknown_key(key, config_name, overrides, more)


def searched(overrides: Sequence[str]) -> list[str]:
    """Those of the overrides that say where Hydra looks for configs."""
    return [text for text in overrides if key_of(text) == SEARCH_PATH]


def explain(
    error: Exception, config_name: str, overrides: Sequence[str], more: Path | None = None
) -> UserError:
    """The one sentence that names the key or group, what was found and the names that exist."""
    if isinstance(error, MissingConfigException) and error.options is not None and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.removesuffix(".yaml").rpartition("/")
        options = sorted(error.options)
        if group == "hydra/launcher":
            return UserError(
                f"Unknown launcher {choice!r}: known here are {', '.join(options)}; submitit_slurm and submitit_local "
                f"come with {install_command('slurm')}, ray with {install_command('ray')}."
            )
        return UserError(
            f"Unknown {group} {choice!r}{suggestion(choice, options)}: there are {', '.join(options)}."
        )
    if isinstance(error, OverrideParseException):
        return UserError(
            f"Cannot read the override {error.override!r}: wanted key=value, such as training.steps=1000."
        )
    overridden = re.match(
        r"(?:Could not|Error) (?:override|append|delete|merging override)\w* '?([^\s'=]+)", str(error)
    )
    if isinstance(error, ConfigCompositionException) and overridden and "Could not override" in str(error):
        return _unknown_key(overridden.group(1).split("@")[0], config_name, overrides, more)
    text = " ".join(str(error.__cause__ or error).split())
    if merged := _MERGED.search(text):
        key, is_mapping = merged.group(1), merged.group(2) == "dict"
        return UserError(
            f"{key} must be {_KINDS[is_mapping]}, found {_KINDS[not is_mapping]}: write it as in "
            f"{shown(CONFIG_DIRECTORY)}."
        )
    if interpolated := _INTERPOLATED.search(text):
        return UserError(
            f"{interpolated.group(2)} takes the value of {interpolated.group(1)}, which {config_name}.yaml does not "
            "have: choose another file of its group, or another command."
        )
    return UserError(
        f"The config {config_name} with {' '.join(overrides) or 'no overrides'} is wrong: {text}"
    )


def _places(override: Override) -> list[str]:
    """What an override of hydra.searchpath names."""
    if override.key_or_group != SEARCH_PATH:
        return []
    places = override.value()
    is_list = isinstance(places, list) and all(isinstance(place, str) for place in places)
    require(is_list, SEARCH_PATH, "a list of folders (file://DIR) and packages (pkg://NAME)", places)
    return places


def _refuse_list_of_choices(override: Override) -> None:
    """Raises UserError where a group is given a list, which Hydra would take for several of its files."""
    is_group = (CONFIG_DIRECTORY / override.key_or_group).is_dir()
    if is_group and not override.is_delete() and isinstance(values := override.value(), list):
        raise UserError(
            f"{override.key_or_group} must be one of its files, found the list {values!r}: write "
            f"{override.key_or_group}=NAME, and -m with {override.key_or_group}=A,B to run several."
        )


def _refuse_absent(place: str) -> None:
    """Raises UserError where a folder or package of hydra.searchpath does not exist; Hydra would only warn."""
    scheme, found, name = place.rpartition("://")
    if found and scheme not in ("file", "pkg"):
        raise UserError(f"{SEARCH_PATH} takes file://DIR and pkg://NAME, found {place!r}.")
    if scheme != "pkg" and not Path(name).is_dir():
        raise UserError(
            f"{SEARCH_PATH} names {place!r}, which is not a directory: name one that holds exp/, ..."
        )
    if scheme == "pkg" and not _is_package(name):
        raise UserError(
            f"{SEARCH_PATH} names {place!r}, which is not a package that is installed here: install it, or write "
            "the name under which its folder of configs is imported."
        )


def _is_package(name: str) -> bool:
    try:
        return bool(name) and find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _groups(keys: Iterable[str], config_name: str, overrides: Sequence[str], more: Path | None) -> set[str]:
    """Those of the keys that are groups, wherever Hydra looks for them."""
    if not keys:
        return set()
    with configs(config_name, more) as hydra:
        options = hydra.config_loader.get_group_options
        return {key for key in keys if options(key, None, config_name, searched(overrides))}


def _unknown_key(key: str, config_name: str, overrides: Sequence[str], more: Path | None) -> UserError:
    groups = _groups({key, *map(key_of, overrides)}, config_name, overrides, more)
    if key in groups:
        given = next((text for text in overrides if key_of(text) == key), f"{key}=...")
        return UserError(f"{key} needs a plus sign: write +{given.lstrip('+')} instead of {given}.")
    choices = [text for text in overrides if key_of(text) in (*groups, SEARCH_PATH)]
    node: Any = _config_of_groups(config_name, choices, more)
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


def _config_of_groups(config_name: str, choices: Sequence[str], more: Path | None) -> dict[str, Any]:
    """The config under overrides that choose groups: its keys are the ones that exist."""
    for trial in (list(choices), []):
        try:
            with configs(config_name, more):
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
            f"{CONFIG_DIRECTORY} does not exist: install imfvla again, from a wheel or with pip install -e . in a "
            "clone."
        )
    return CONFIG_DIRECTORY
