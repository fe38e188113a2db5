"""A progress bar with time left on a terminal, plain lines elsewhere."""

import logging
import sys
import time
from types import TracebackType

from rich import progress as rich_progress
from rich.console import Console

log = logging.getLogger(__name__)

LINE_EVERY_S = 15.0  # seconds between lines where nobody watches a bar


class Progress:
    """Counts `total` items of work: `with Progress("socket", 100) as bar: bar.advance("success 9 of 10")`."""

    def __init__(self, title: str, total: int, done: int = 0) -> None:
        self._title, self._total, self._done, self._already = title, total, done, done
        self._bar: rich_progress.Progress | None = None

    def __enter__(self) -> "Progress":
        self._began = self._last_line = time.monotonic()
        if sys.stderr.isatty():
            self._bar = rich_progress.Progress(
                rich_progress.TextColumn("{task.description}"),
                rich_progress.BarColumn(),
                rich_progress.MofNCompleteColumn(),
                rich_progress.TextColumn("{task.fields[note]}"),
                rich_progress.TimeElapsedColumn(),
                rich_progress.TextColumn("left"),
                rich_progress.TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._task = self._bar.add_task(self._title, total=self._total, completed=self._done, note="")
            self._bar.start()
        return self

    def advance(self, note: str = "") -> None:
        """One item is done; `note` is what to show beside the count."""
        self._done += 1
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, note=note)
            return
        now = time.monotonic()
        if now - self._last_line >= LINE_EVERY_S or self._done == self._total:
            self._last_line = now
            elapsed = now - self._began
            left = elapsed / (self._done - self._already) * (self._total - self._done)
            log.info(
                "%s: %d of %d  %s  %.0f s, %.0f s left",
                self._title, self._done, self._total, note, elapsed, left,
            )  # fmt: skip

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
