"""Opens the source of episodes that `demos` chooses. Each kind is a module beside this one, imported when chosen."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from imfvla.config.construction import construct
from imfvla.options import one_of, part_of, require
from imfvla.sources.base import EpisodeSource

SCRIPTED = "scripted"  # the expert of our own tasks; missing demonstrations are recorded
KINDS = (SCRIPTED, "mcap", "lerobot", "ros2", "hdf5")
COMPONENT = "component"  # a class that another package registers: demos._target_
SHARED = (
    "source",
    "frames_directory",
)  # keys of `demos` that every kind has; a kind's module is not given them


def source_kind(config: Mapping[str, Any]) -> str:
    """Which source `demos` names, one of KINDS, or COMPONENT where there is a `_target_`.

    Configs from before these keys are of the scripted expert.
    """
    demos = part_of(config, "demos")
    require(isinstance(demos, Mapping), "demos", "a mapping of keys to values", demos)
    if "_target_" in demos:
        return COMPONENT
    kind = demos.get("source", SCRIPTED)
    allowed = one_of(*KINDS)
    require(isinstance(kind, str) and allowed.holds(kind), "demos.source", allowed.wanted, kind)
    return kind


def open_source(config: Mapping[str, Any]) -> EpisodeSource:
    """The episodes that a config composed from `conf/train.yaml` trains on.

    The scripted expert records missing demonstrations first. A `_target_` is a class that another package registers; it
    is given the other keys of `demos`. Raises UserError where options are wrong or files are
    missing or damaged.
    """
    kind = source_kind(config)
    if kind == SCRIPTED:
        # Imported here: a data set needs no simulator.
        from imfvla.sources.scripted import open_source as open_scripted

        return open_scripted(config)
    options = {key: value for key, value in config["demos"].items() if key not in SHARED}
    if kind == COMPONENT:
        return construct(options, "demos", EpisodeSource)
    return import_module(f"imfvla.sources.{kind}").open_source(options, where="demos")
