"""What surrounds `python -m imfvla.<name>` besides `imfvla.command`: Hydra, sweeps, the failures of their jobs."""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from imfvla.command import EXIT_FAILURE, EXIT_USER_ERROR, as_command, composition
from imfvla.command.help import help_text
from imfvla.command.jobs import Failure, HydraJob
from imfvla.command.line import in_hydras_words, multiplies, refuse_ignored
from imfvla.command.planning import names_a_sweep
from imfvla.command.sweep import IsFinished, run_sweep
from imfvla.errors import REMEDIES, WHERE_MISSING, UserError, as_user_error
from imfvla.process.visible import visible


def entry_point(
    config_name: str, is_finished: IsFinished | None = None, usage: Callable[[], str] | None = None
) -> Callable[[Callable[[dict[str, Any]], None]], Callable[..., None]]:
    """Decorator: `function(config)` becomes a command that composes `conf/<config_name>.yaml`.

    The function receives the resolved config as plain dicts and lists. The command `main(argv=None)` returns
    on success and otherwise exits: 2 after a UserError, whose text alone goes to stderr; 130 after Ctrl-C, 143
    after SIGTERM, 138 after SIGUSR1 (rerun the same command to resume); 1 with a traceback after anything else. In
    a sweep (`-m`, or `+sweep=NAME` for one of conf/sweep) all jobs run except those that
    `is_finished(config, directory)` recognises by their files; the failures are listed at the end. With a
    `usage`, a command without any override only prints it and exits with 2. The config
    overrides `hydra/output` and `hydra/job_logging`, both with `run` (deterministic run directory, see
    `output_directory`, and its train.log) or both with `plain` (nothing written).
    """

    def decorate(function: Callable[[dict[str, Any]], None]) -> Callable[..., None]:
        @wraps(function)
        def main(argv: Sequence[str] | None = None) -> None:
            arguments = list(sys.argv[1:] if argv is None else argv)
            code = _run(HydraJob(function, config_name), arguments, is_finished, usage)
            if code:
                sys.exit(code)

        return main

    return decorate


def output_directory() -> Path:
    """Inside an entry point: this job's directory from Hydra (`hydra.run.dir`)."""
    return Path(HydraConfig.get().runtime.output_dir)


@as_command
def _run(
    job: HydraJob, arguments: list[str], is_finished: IsFinished | None, usage: Callable[[], str] | None
) -> int:
    composition.register_resolvers()
    known = get_args_parser().parse_intermixed_args(arguments)
    is_bare = not (known.overrides or _shows_only(known))
    is_sweep = _is_sweep(known)
    flags = [text for text in arguments if text not in known.overrides]
    known.overrides = in_hydras_words(known.overrides, is_sweep)
    if os.environ.get("RANK", "0") != "0":  # torchrun's: of several processes the first one writes
        known.overrides.append("hydra/job_logging=disabled")
    arguments = [*flags, *known.overrides]  # Hydra rejects overrides on both sides of a flag
    more = Path(known.config_dir).absolute() if known.config_dir else None
    try:
        with _hydra_raises(arguments):
            refuse_ignored(known, is_sweep)
            if usage and is_bare:
                raise UserError(usage())
            composition.refuse_added_keys(job.config_name, known.overrides, more)
            if known.help:
                description = sys.modules[job.function.__module__].__doc__ or ""
                print(help_text(job.config_name, description, known.overrides, more))
                return 0
            if is_sweep:
                failures = run_sweep(job, known.overrides, is_finished, more)
            else:
                _run_once(job)
                failures = [job.failure] if job.failure else []
    except (HydraException, OmegaConfBaseException) as error:
        raise composition.explain(error, job.config_name, known.overrides, more) from error
    except (OSError, ValueError) as error:  # ours, and of what Hydra itself writes: directories, train.log
        if (known_error := as_user_error(error, REMEDIES | WHERE_MISSING)) is None:
            raise
        raise known_error from error
    return _report(failures)


def _run_once(job: HydraJob) -> None:
    path = str(composition.config_directory())
    hydra.main(config_path=path, config_name=job.config_name, version_base=composition.VERSION_BASE)(job)()


def _is_sweep(known: argparse.Namespace) -> bool:
    return not _shows_only(known) and (multiplies(known) or names_a_sweep(known.overrides))


def _shows_only(known: argparse.Namespace) -> bool:
    return bool(known.help or known.hydra_help or known.cfg or known.info or known.shell_completion)


@contextmanager
def _hydra_raises(arguments: Sequence[str]) -> Iterator[None]:
    """Passes these arguments to Hydra, and makes it raise its errors instead of printing them."""
    full_error, sys_argv = os.environ.get("HYDRA_FULL_ERROR"), sys.argv
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = [sys.argv[0], *arguments]
    try:
        yield
    finally:
        sys.argv = sys_argv
        os.environ.pop("HYDRA_FULL_ERROR")
        if full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def _report(failures: Sequence[Failure]) -> int:
    """Prints the failures and returns the exit code."""
    for failure in failures:
        prefix = f"[{failure.overrides}] " if len(failures) > 1 else ""
        # A sentence for a user is one line; a traceback has several.
        text = visible(failure.text) if failure.is_user_error else failure.text
        print(f"{visible(prefix)}{text}", file=sys.stderr)
    if all(failure.is_user_error for failure in failures):
        return EXIT_USER_ERROR if failures else 0
    return EXIT_FAILURE
