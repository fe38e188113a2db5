"""The jobs of a sweep: their overrides, configs and directories, before any of them runs.

`-m key=1,2` gives every combination. `+sweep=NAME` gives the jobs of `conf/sweep/NAME.yaml`, each of them a list of
overrides in Hydra's grammar or a row of the paper's tables; the other overrides apply to all of them.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imfvla.command import composition
from imfvla.errors import UserError
from imfvla.options import build, is_whole, require
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.mapping.row import TableRow
from imfvla.storage.run_directory import EXECUTION_KEYS, LAST, differences
from imfvla.storage.run_names import key_of

GROUP = "sweep"


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """A file of conf/sweep."""

    tables: tuple[str, ...]  # of experiments/tables.yaml: all their rows that a run answers
    # Overrides of each job; commas and ranges in one give every combination, as with -m.
    jobs: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Planned:
    """A job: its overrides, its composed config as plain dicts, and the directory that Hydra will give it."""

    overrides: tuple[str, ...]
    config: dict[str, Any]
    directory: Path


def names_a_sweep(overrides: Sequence[str]) -> bool:
    """Whether there is a `+sweep=NAME` among the overrides."""
    return any(key_of(text) == GROUP for text in overrides)


def planned_jobs(config_name: str, overrides: Sequence[str]) -> list[Planned]:
    """The jobs that `imfvla.command.sweep.run_sweep` would look at, in its order; raises as it does."""
    with composed(config_name, overrides, False) as (loader, master, chosen):
        return plan(loader, master, chosen)


@contextmanager
def composed(
    config_name: str, overrides: Sequence[str], with_log_configuration: bool, more: Path | None = None
) -> Iterator[tuple[ConfigLoader, DictConfig, list[str]]]:
    """Hydra's loader, the config that all jobs have in common, and the overrides that name sweeps."""
    with composition.configs(config_name, more) as hydra:
        common = [text for text in overrides if key_of(text) != GROUP]
        chosen = [text for text in overrides if key_of(text) == GROUP]
        master = hydra.compose_config(config_name, common, RunMode.MULTIRUN, with_log_configuration)
        yield hydra.config_loader, master, chosen


def plan(loader: ConfigLoader, master: DictConfig, chosen: Sequence[str]) -> list[Planned]:
    """The jobs of `+sweep=...` under the overrides of `master`, or of these alone; none twice.

    As with Hydra's sweeper, `hydra.sweeper.params` come before the overrides. Raises UserError for another sweeper.
    """
    parser = OverridesParser.create(config_loader=loader)
    common = [*_params_of(master), *master.hydra.overrides.task]
    files = [name for override in parser.parse_overrides(list(chosen)) for name in _names(override)]
    config_name = master.hydra.job.config_name
    places = composition.searched(OmegaConf.to_container(master.hydra.overrides.hydra))
    lists = [job for name in files for job in _jobs_of_file(loader, config_name, name, places)]
    lists = lists if files else [()]
    products = [BasicSweeper.split_arguments(parser.parse_overrides([*own, *common]), None) for own in lists]
    every = dict.fromkeys(tuple(job) for (product,) in products for job in product)
    planned = [_planned(loader, master, job) for job in every]
    _refuse_shared_directories(planned)
    return planned


def jobs_of_rows(rows: Sequence[TableRow]) -> list[tuple[str, ...]]:
    """For each run and checkpoint that rows need, the overrides that train and evaluate it as they require."""
    numbers: dict[tuple[str, ...], list[int]] = {}
    for row in rows:
        wanted = {name: getattr(row.wanted, name) for name in row.wanted.__slots__}
        wanted |= {"checkpoint": row.checkpoint} if row.checkpoint != LAST else {}
        protocol = (f"evaluation.{name}={value}" for name, value in wanted.items())
        evaluated = (*protocol, *row.options("evaluation."))
        numbers.setdefault((f"+exp={row.experiment}", *row.overrides, *evaluated), []).append(row.nfe)
    return [
        (*job, f"evaluation.nfe=[{','.join(map(str, sorted(counts)))}]") for job, counts in numbers.items()
    ]


def path_of(plugin: type) -> str:
    """What `_target_` says of one of Hydra's plugins."""
    return f"{plugin.__module__}.{plugin.__qualname__}"


def _params_of(config: DictConfig) -> list[str]:
    """`hydra.sweeper.params` as overrides. Raises UserError where the sweeper is not Hydra's basic one."""
    sweeper = config.hydra.sweeper
    require(
        sweeper._target_ == path_of(BasicSweeper),
        "hydra/sweeper",
        "basic, since commands run the jobs of a sweep in their own way",
        sweeper._target_,
    )
    size = sweeper.max_batch_size
    require(
        size is None or (is_whole(size) and size >= 1),
        "hydra.sweeper.max_batch_size",
        "null or at least 1",
        size,
    )
    params = OmegaConf.to_container(sweeper.params, resolve=True) if sweeper.params else {}
    require(isinstance(params, dict), "hydra.sweeper.params", "a mapping of keys to choices", params)
    return [f"{key}={value}" for key, value in params.items()]


def _refuse_shared_directories(planned: Sequence[Planned]) -> None:
    """Raises UserError where jobs that train different policies would do so in one directory."""
    first: dict[Path, Planned] = {}
    for job in planned:
        other = first.setdefault(job.directory, job)
        if job.directory.name and (differing := differences(other.config, job.config, EXECUTION_KEYS)):
            raise UserError(
                f"Two jobs of this sweep would share {job.directory}, though {'; '.join(differing)}: leave "
                "hydra.sweep.dir and hydra.sweep.subdir as they are, or let subdir name every key that differs."
            )


def _names(override: Override) -> list[str]:
    if override.is_sweep_override():
        return list(override.sweep_string_iterator())
    return [override.get_value_element_as_str()]


def _jobs_of_file(
    loader: ConfigLoader, config_name: str, name: str, places: Sequence[str]
) -> list[tuple[str, ...]]:
    config = loader.load_configuration(config_name, [*places, f"+{GROUP}={name}"], RunMode.RUN)
    where = f"{GROUP}/{name}.yaml"
    read = build(SweepOptions, OmegaConf.to_container(config[GROUP]), where)
    known = [table.name for table in (*read_mapping().of_rows, *read_mapping().of_settings)]
    require({*read.tables} <= {*known}, f"{where}: tables", f"a list from {', '.join(known)}", read.tables)
    rows = [row for table in read.tables for row in read_mapping().of_table(table)]
    return [*jobs_of_rows(rows), *read.jobs]


def _planned(loader: ConfigLoader, master: DictConfig, overrides: tuple[str, ...]) -> Planned:
    config = loader.load_sweep_config(master, list(overrides))
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)  # the directory's name is resolved from it
    try:
        directory = Path(config.hydra.sweep.dir) / str(config.hydra.sweep.subdir)
    except OmegaConfBaseException as error:
        raise UserError(
            f"hydra.sweep.dir and hydra.sweep.subdir must depend only on the config and the overrides, so that a "
            f"sweep finds its jobs again; found {' '.join(str(error).split())}"
        ) from error
    finally:
        HydraConfig.instance().cfg = before
    if _params_of(config) != _params_of(master):
        raise UserError(
            f"{' '.join(overrides)} has hydra.sweeper.params of its own, which a job of a sweep cannot expand: "
            "run its experiment alone, or write its choices on the command line."
        )
    plain = composition.to_plain(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"]))
    return Planned(overrides, plain, directory)
