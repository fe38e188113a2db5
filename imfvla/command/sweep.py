"""Runs the jobs of a sweep: those that are not finished, through Hydra's launcher."""

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext

from imfvla.command.jobs import Failure, HydraJob, is_lost
from imfvla.command.planning import Planned, composed, path_of, plan
from imfvla.process.progress import Progress

STILL_RUNNING = "Not finished yet; it may still be running."
LOOK_EVERY_S = 5.0  # seconds between looks at what jobs in other processes have finished
IsFinished = Callable[[dict[str, Any], Path], bool]
log = logging.getLogger(__name__)


def run_sweep(
    job: HydraJob, overrides: Sequence[str], is_finished: IsFinished | None, more: Path | None = None
) -> list[Failure]:
    """Runs the jobs that are not finished and returns what failed; one failure stops no other job.

    Args:
      job: the task function.
      overrides: of the command line.
      is_finished: whether a job's config and directory show that nothing is left to do; None runs every job.
      more: a directory of configs beside `conf`, as --config-dir names it.

    Raises:
      UserError, HydraException: a job that cannot be composed, before any runs.
    """
    job.is_of_sweep = True
    with composed(job.config_name, overrides, True, more) as (loader, master, chosen):
        callbacks = Callbacks(master)
        context = HydraContext(config_loader=loader, callbacks=callbacks)
        planned = plan(loader, master, chosen)
        launcher = Plugins.instance().instantiate_launcher(context, job, master)
        is_here = master.hydra.launcher._target_ == path_of(BasicLauncher)
        callbacks.on_multirun_start(config=master, config_name=job.config_name)
        size = master.hydra.sweeper.max_batch_size
        failures = _Sweep(launcher, is_here, job.config_name, is_finished, size).run(planned)
        callbacks.on_multirun_end(config=master, config_name=job.config_name)
        return failures


def waves(planned: Sequence[Planned]) -> list[list[Planned]]:
    """Groups of jobs that may run at the same time: the first job of each run directory, then the second, and so on."""
    number: Counter[Path] = Counter()
    found: list[list[Planned]] = []
    for job in planned:
        wave = number[job.directory]
        # A job without a directory of its own shares nothing.
        number[job.directory] += job.directory.name != ""
        found += [[]] * (wave == len(found))
        found[wave] = [*found[wave], job]
    return found


class _Sweep:
    def __init__(
        self,
        launcher: Launcher,
        is_here: bool,
        config_name: str,
        is_finished: IsFinished | None,
        max_batch_size: int | None = None,
    ) -> None:
        self._launcher, self._is_here = launcher, is_here
        self._config_name, self._is_finished = config_name, is_finished
        self._size = 1 if is_here else max_batch_size

    def run(self, planned: Sequence[Planned]) -> list[Failure]:
        waiting = [job for job in planned if not self._has_finished(job)]
        for job in planned:
            if job not in waiting:
                log.info("Finished already: %s", job.directory)
        failures: list[Failure] = []
        number = skipped = len(planned) - len(waiting)
        with Progress("sweep", len(planned), done=skipped) as bar:
            for batch in self._batches(waiting):
                with self._counted(batch, bar):
                    failures += self._launch(batch, number)
                number += len(batch)
        ran = len(waiting) - len(failures)
        log.info(
            "Jobs: %d, of which %d were finished before, %d ran and %d failed.",
            len(planned),
            skipped,
            ran,
            len(failures),
        )
        return failures

    def _has_finished(self, job: Planned) -> bool:
        return self._is_finished is not None and self._is_finished(job.config, job.directory)

    def _batches(self, waiting: Sequence[Planned]) -> list[list[Planned]]:
        """What the launcher gets at once; one job at a time in this process, so that none can end the others' sweep."""
        batches = []
        for wave in waves(waiting):
            size = self._size or len(wave)
            batches += [wave[first : first + size] for first in range(0, len(wave), size)]
        return batches

    def _launch(self, batch: Sequence[Planned], number: int) -> list[Failure]:
        try:
            returned = self._launcher.launch([list(job.overrides) for job in batch], initial_job_idx=number)
            return [failure for result in returned if (failure := result.return_value) is not None]
        # From the launcher or a process that died: every job that has not finished has failed.
        except Exception as error:
            left = [" ".join(job.overrides) for job in batch if not self._has_finished(job)]
            first = [Failure.of(error, self._config_name, overrides) for overrides in left[:1]]
            # Of a launcher that starts all jobs at once the others may still be running.
            lost, text = is_lost(error), "Not finished, for the same reason."
            return first + [Failure(other, STILL_RUNNING if lost else text, lost) for other in left[1:]]

    @contextmanager
    def _counted(self, batch: Sequence[Planned], bar: Progress) -> Iterator[None]:
        """Counts the jobs of a batch as they finish, in any process, and at its end those that failed too."""
        ended, left = threading.Event(), list(batch)

        def look() -> None:
            while not ended.wait(LOOK_EVERY_S):
                for job in [job for job in left if self._has_finished(job)]:
                    left.remove(job)
                    bar.advance()

        watcher = threading.Thread(target=look, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            ended.set()
            watcher.join()
        for _ in left:
            bar.advance()
