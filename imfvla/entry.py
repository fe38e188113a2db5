"""What `python -m imfvla.<name>` has around it: Hydra, one clear line for a user's mistake, exit codes."""

import logging
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from imfvla import composition
from imfvla.errors import UserError

EXIT_FAILURE, EXIT_USER_ERROR, EXIT_INTERRUPTED = 1, 2, 130
log = logging.getLogger(__name__)


def entry_point(config_name: str) -> Callable[[Callable[[dict[str, Any]], None]], Callable[..., None]]:
    """Decorator: `function(config)` becomes a command that composes `conf/<config_name>.yaml`.

    The function receives the resolved config as plain dicts and lists. The command `main(argv=None)` returns
    on success and otherwise exits: 2 after a UserError, whose text alone goes to stderr; 130 after Ctrl-C; 1
    with a traceback after anything else. In a sweep (`-m`) all jobs run; the failures are listed at the end.
    The config overrides `hydra/output` and `hydra/job_logging`, both with `run` (deterministic run directory,
    see `output_directory`, and its train.log) or both with `plain` (nothing written).
    """

    def decorate(function: Callable[[dict[str, Any]], None]) -> Callable[..., None]:
        @wraps(function)
        def main(argv: Sequence[str] | None = None) -> None:
            arguments = list(sys.argv[1:] if argv is None else argv)
            code = _run(function, config_name, arguments)
            if code:
                sys.exit(code)

        return main

    return decorate


def output_directory() -> Path:
    """Inside an entry point: the directory that Hydra gave this job (`hydra.run.dir`)."""
    return Path(HydraConfig.get().runtime.output_dir)


def _run(function: Callable[[dict[str, Any]], None], config_name: str, arguments: list[str]) -> int:
    composition.register_resolvers()
    failures: list[tuple[str, Exception]] = []

    def job(config: DictConfig) -> None:
        task_overrides = list(HydraConfig.get().overrides.task)
        try:
            function(composition.to_plain(config))
        except Exception as error:  # noted and reported below, so that the other jobs of a sweep run
            failures.append((" ".join(task_overrides), error))

    overrides = get_args_parser().parse_args(arguments).overrides
    full_error, sys_argv = os.environ.get("HYDRA_FULL_ERROR"), sys.argv
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing in its own way
    sys.argv = [sys.argv[0], *arguments]
    try:
        composition.refuse_added_keys(config_name, overrides)
        config_path = str(composition.CONFIG_DIRECTORY)
        hydra.main(config_path=config_path, config_name=config_name, version_base=composition.VERSION_BASE)(
            job
        )()
    except (HydraException, OmegaConfBaseException, UserError) as error:
        failures.append((" ".join(overrides), error))
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return EXIT_INTERRUPTED
    finally:
        sys.argv = sys_argv
        os.environ.pop("HYDRA_FULL_ERROR")
        if full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = full_error
    return _report(failures, config_name)


def _report(failures: list[tuple[str, Exception]], config_name: str) -> int:
    """Prints the failures and returns the exit code."""
    code = 0
    for overrides, error in failures:
        if isinstance(error, HydraException | OmegaConfBaseException):
            error = composition.explain(error, config_name, overrides.split())
        prefix = f"[{overrides}] " if len(failures) > 1 else ""
        if isinstance(error, UserError):
            print(f"{prefix}{error}", file=sys.stderr)
            code = code or EXIT_USER_ERROR
        else:
            print(f"{prefix}{''.join(traceback.format_exception(error))}", end="", file=sys.stderr)
            code = EXIT_FAILURE
    return code
