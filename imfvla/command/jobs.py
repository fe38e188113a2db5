"""One job of a command, as Hydra's launchers run it, here or on another machine: a failure comes back as a value."""

import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from imfvla.command import composition
from imfvla.errors import UserError, as_user_error

RERUN = (
    "Rerun the same command once no job of it runs any more: finished jobs are skipped, and others resume."
)
LOST = "UncompletedJobError"  # submitit's, which need not be installed


@dataclass(frozen=True, slots=True)
class Failure:
    """The report of a job that failed: one sentence for a user's mistake, else a traceback."""

    overrides: str
    text: str
    is_user_error: bool

    @classmethod
    def of(cls, error: Exception, config_name: str, overrides: str) -> "Failure":
        if isinstance(error, HydraException | OmegaConfBaseException):
            error = composition.explain(error, config_name, overrides.split())
        known = as_user_error(error)
        if known is not None:
            return cls(overrides, str(known), True)
        if is_lost(error):
            what = " ".join(str(error).splitlines()[:2])
            return cls(
                overrides, f"A job ended without a result, as one does that is killed ({what}). {RERUN}", True
            )
        return cls(overrides, "".join(traceback.format_exception(error)).rstrip("\n"), False)


def is_lost(error: Exception) -> bool:
    """Whether a launcher says that a process ended without a result."""
    return type(error).__name__ == LOST


def remove_empty(directory: Path) -> None:
    """Removes a folder below the working directory that holds nothing, and those above it that held nothing else.

    So a job that is refused before it writes anything leaves no run directory, which Hydra makes for every job.
    """
    here = Path.cwd()
    with suppress(OSError):  # it holds something
        while directory.is_relative_to(here) and directory != here:
            directory.rmdir()
            directory = directory.parent


class HydraJob:
    """Hydra's task function around `function(config)`: plain config in, None or a Failure out.

    Launchers send it to other processes by pickle; there it registers the configs' resolvers again.
    """

    def __init__(self, function: Callable[[dict[str, Any]], None], config_name: str) -> None:
        self.function, self.config_name = function, config_name
        self.is_of_sweep = False
        self.failure: Failure | None = None  # of the last call in this process

    def __call__(self, config: DictConfig) -> Failure | None:
        self.failure = None
        overrides = " ".join(HydraConfig.get().overrides.task)
        try:
            self._refuse_hydras_own_ways(HydraConfig.get())
            self.function(composition.to_plain(config))
        except Exception as error:  # reported at the end, so that the other jobs of a sweep run
            self.failure = Failure.of(error, self.config_name, overrides)
            remove_empty(Path(HydraConfig.get().runtime.output_dir))
        return self.failure

    def _refuse_hydras_own_ways(self, hydra: DictConfig) -> None:
        """Raises UserError where a config file makes Hydra run jobs in a way that is not supported here."""
        if hydra.mode == RunMode.MULTIRUN and not self.is_of_sweep:
            raise UserError(
                "hydra.mode is MULTIRUN in a config file: remove it there and add -m to the command."
            )
        if hydra.job.chdir:
            raise UserError(
                "hydra.job.chdir must be false, found true: paths are relative to where the command starts."
            )

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        composition.register_resolvers()
