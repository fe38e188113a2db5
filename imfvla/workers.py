"""Work shared out to fresh processes with one thread each, or done in this one."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from imfvla.errors import UserError

RunAll = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[Any]]


@contextmanager
def worker_pool(count: int) -> Iterator[RunAll]:
    """Yields `run_all(function, calls)`: results of `function(*arguments)` for each call, as they complete.

    The work is done in `count` fresh processes with one thread each, or in this one for 0.
    Raises UserError where a worker dies.
    """
    if count == 0:
        yield lambda function, calls: (function(*arguments) for arguments in calls)
        return
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # inherited by the workers, which read it when they load torch
    executor = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))

    def run_all(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        for future in as_completed([executor.submit(function, *arguments) for arguments in calls]):
            yield future.result()

    try:
        yield run_all
    except BrokenProcessPool as error:
        raise UserError(
            "A worker process died, perhaps for want of memory: choose fewer workers=... and run the same "
            "command again; finished episodes are kept."
        ) from error
    finally:
        executor.shutdown(cancel_futures=True)
        os.environ.pop("OMP_NUM_THREADS")
        if before is not None:
            os.environ["OMP_NUM_THREADS"] = before
