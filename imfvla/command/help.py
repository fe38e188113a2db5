"""What --help prints: what the command does, the groups that its config chooses from, and that config.

Hydra's own help copies all configs for each group that it lists, which takes seconds.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill

from hydra import compose
from hydra._internal.config_repository import IConfigRepository
from hydra.core.object_type import ObjectType
from omegaconf import OmegaConf

from imfvla.command.composition import configs

WIDTH = 100
ADDED = {"train": ("exp", "sweep")}  # groups that an override adds with a plus sign, by command
FLAGS = """--cfg job prints the config that the overrides make and runs nothing; --info explains where it comes from.
--config-dir DIR adds a folder of configs; --hydra-help lists Hydra's own flags and groups."""


def help_text(config_name: str, description: str, overrides: Sequence[str], more: Path | None) -> str:
    """The help of a command under these overrides. Raises Hydra's and OmegaConf's errors where they are wrong."""
    with configs(config_name, more) as hydra:
        _, repository = hydra.config_loader._parse_overrides_and_create_caching_repo(
            config_name, [*overrides]
        )
        groups = dict(_groups(repository))
        config = compose(config_name, [*overrides], return_hydra_config=True)
    added = ADDED.get(config_name, ())
    chosen = {name.partition("@")[0].split("/")[0] for name in config.hydra.runtime.choices}
    shown = [
        name for name in sorted(groups) if name.split("/")[0] in chosen - {"hydra"} and name not in added
    ]
    del config.hydra
    named = {name: groups[name] for name in shown} | {f"+{name}": groups[name] for name in added}
    lines = [
        fill(f"{name}: {', '.join(sorted(choices))}", WIDTH, subsequent_indent="  ")
        for name, choices in named.items()
    ]
    parts = [description.strip()]
    if lines:
        parts.append("Groups, of which group=choice takes one:\n\n" + "\n".join(lines))
    keys = OmegaConf.to_yaml(config).rstrip()
    return "\n\n".join([*parts, f"Keys, which key.of.key=value changes:\n\n{keys}", FLAGS])


def _groups(repository: IConfigRepository, parent: str = "") -> Iterator[tuple[str, list[str]]]:
    """Each group below `parent` with its choices, without those of Hydra."""
    for name in repository.get_group_options(parent, ObjectType.GROUP):
        group = f"{parent}/{name}" if parent else name
        if group != "hydra":
            if choices := repository.get_group_options(group, ObjectType.CONFIG):
                yield group, choices
            yield from _groups(repository, group)
