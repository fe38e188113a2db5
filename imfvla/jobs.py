"""One job of a command, as Hydra's launchers run it, here or on another machine: a failure comes back as a value."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from imfvla import composition
from imfvla.errors import told


@dataclass(frozen=True, slots=True)
class Failure:
    """What is told of a job that failed: one sentence for a user's mistake, else a traceback."""

    overrides: str
    text: str
    is_user_error: bool

    @classmethod
    def of(cls, error: Exception, config_name: str, overrides: str) -> "Failure":
        if isinstance(error, HydraException | OmegaConfBaseException):
            error = composition.explain(error, config_name, overrides.split())
        known = told(error)
        if known is not None:
            return cls(overrides, str(known), True)
        return cls(overrides, "".join(traceback.format_exception(error)).rstrip("\n"), False)


class Job:
    """Hydra's task function around `function(config)`: plain config in, None or a Failure out.

    Launchers send it to other processes by pickle; there it makes the configs' resolvers known again.
    """

    def __init__(self, function: Callable[[dict[str, Any]], None], config_name: str) -> None:
        self.function, self.config_name = function, config_name
        self.failure: Failure | None = None  # of the last call in this process

    def __call__(self, config: DictConfig) -> Failure | None:
        self.failure = None
        overrides = " ".join(HydraConfig.get().overrides.task)
        try:
            self.function(composition.to_plain(config))
        except Exception as error:  # told at the end, so that the other jobs of a sweep run
            self.failure = Failure.of(error, self.config_name, overrides)
        return self.failure

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        composition.register_resolvers()
