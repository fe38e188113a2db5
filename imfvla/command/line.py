"""The arguments of a command line: rewritten for Hydra's grammar, and refused where they would be ignored."""

import argparse
import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from imfvla.errors import UserError

# Keys of all commands whose values are names and paths, which Hydra would take for lists, choices and numbers.
TEXTS = (
    "core.pretrained", "demos.directory", "demos.frames_directory", "demos.path", "directory",
    "encoder.vision.pretrained", "frames_directory", "from.path", "hydra.run.dir", "hydra.sweep.dir",
    "mapping", "name", "output", "run", "to.path",
)  # fmt: skip
TEXTS_OR_LISTS = ("demos.path", "from.path")
LISTS_OF_TEXTS = ("directories", "runs")
LISTS_OF_NUMBERS = ("nfe", "evaluation.nfe")
# Hydra's own flags that would be ignored or would bypass what a command does around a job, with the alternative.
NOT_TAKEN = {
    "config_name": "each command has one config",
    "config_path": "name a folder of more configs with --config-dir",
    "experimental_rerun": "rerun the command",
}
# Hydra's own keys that act only in a sweep, and those that act only outside of one.
OF_SWEEPS = ("hydra/launcher", "hydra.launcher", "hydra/sweeper", "hydra.sweeper", "hydra.sweep")
OF_SINGLE_JOBS = ("hydra.run",)


def in_hydras_words(overrides: Sequence[str], is_sweep: bool = False) -> list[str]:
    """The overrides, with the values of `TEXTS` and `LISTS_OF_TEXTS` quoted where Hydra would misread them.

    In a sweep, commas outside of paths that exist give choices, as in any other key; outside of one, `nfe=1,2,3` is a
    list.
    """
    return [_in_hydras_words(text, is_sweep) for text in overrides]


def refuse_ignored(known: argparse.Namespace, is_sweep: bool) -> None:
    """Raises UserError where a flag or key of Hydra would be ignored, naming it and the alternative."""
    for flag, instead in NOT_TAKEN.items():
        if getattr(known, flag) is not None:
            raise UserError(f"--{flag.replace('_', '-')} is not supported: {instead}.")
    modes = {"--run": known.run, "-m": known.multirun, "--cfg": known.cfg, "--info": known.info}
    modes |= {"--shell-completion": known.shell_completion}
    if len(chosen := [flag for flag, value in modes.items() if value]) > 1:
        raise UserError(f"{' and '.join(chosen)} exclude each other: drop one.")
    if known.package and not known.cfg:
        raise UserError("--package selects what --cfg shows: add --cfg job.")
    if known.resolve and not (known.cfg or known.help):
        raise UserError("--resolve acts only with --cfg: add --cfg job.")
    if known.config_dir is not None and not os.path.isdir(known.config_dir):
        raise UserError(
            f"--config-dir {known.config_dir} is not a directory: name one that holds exp/, task/, ..."
        )
    for override in known.overrides:
        key = override.lstrip("+~").partition("=")[0]
        if is_sweep and key.startswith("hydra.sweeper.params"):
            raise UserError(
                f"{key} works only in a config file: on the command line write the choices themselves, as in seed=0,1."
            )
        if not is_sweep and key.startswith(OF_SWEEPS):
            raise UserError(f"{key} acts only in a sweep: add -m, or drop it.")
        if is_sweep and key.startswith(OF_SINGLE_JOBS):
            raise UserError(
                f"{key} acts only outside of a sweep: with -m use {key.replace('.run', '.sweep')}."
            )


def multiplies(known: argparse.Namespace) -> bool:
    """Whether the flags and overrides ask for a sweep in Hydra's way: -m, or hydra.mode=MULTIRUN."""
    modes = [text.partition("=")[2] for text in known.overrides if text.lstrip("+").startswith("hydra.mode=")]
    return known.multirun or "MULTIRUN" in modes[-1:]


def quoted(text: str) -> str:
    """`text` quoted in Hydra's grammar, so that it is taken literally."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)  # backslashes escape only before quotes
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def _in_hydras_words(argument: str, is_sweep: bool) -> str:
    key, equals, value = argument.partition("=")
    name = key.lstrip("+")
    if name in LISTS_OF_NUMBERS and not is_sweep and re.fullmatch(r"\d+(,\d+)+", value):
        return f"{key}=[{value}]"
    if not equals or name not in (*TEXTS, *LISTS_OF_TEXTS):
        return argument
    if name in TEXTS_OR_LISTS and value.startswith("[") and not os.path.exists(value):
        return argument
    if name in TEXTS:
        return f"{key}={_text(value, is_sweep)}"
    if _read(value) is not _UNREADABLE and value.startswith("["):
        return argument
    items = [value] if os.path.exists(value) else value.removeprefix("[").removesuffix("]").split(",")
    return f"{key}=[{','.join(_text(item.strip(), False) for item in items)}]"


def _text(value: str, is_sweep: bool) -> str:
    """`value` itself where Hydra reads it as this text or as another intended value, else quoted."""
    if value.startswith("~/"):
        value = os.path.expanduser(value)  # as shells do at the beginning of a word
    read = _read(value)
    is_meant = read is None or (isinstance(read, str) and value[:1] in ("'", '"'))
    if read == value or is_meant or (is_sweep and "," in value and not os.path.exists(value)):
        return value
    return quoted(value)


_UNREADABLE = object()


def _read(value: str) -> Any:
    """What Hydra makes of a value."""
    try:
        override = OverridesParser.create().parse_override(f"key={value}")
        return override.value() if not override.is_sweep_override() else _UNREADABLE
    except HydraException:
        return _UNREADABLE
