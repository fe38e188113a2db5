"""A progress bar with time left on a terminal, plain lines elsewhere."""

import logging
import sys
import time
from datetime import timedelta
from types import TracebackType
from typing import ClassVar

from rich import progress as rich_progress
from rich.console import Console
from rich.text import Text

from imfvla.process.visible import styled, visible

log = logging.getLogger(__name__)

LINE_EVERY_S = 15.0  # seconds between lines where there is no terminal


class Progress:
    """Counts `total` items of work: `with Progress("socket", 100) as bar: bar.advance("success 9 of 10")`.

    Inside another one, as a job inside a sweep, it is a line below that one's on the terminal.
    """

    _display: ClassVar[rich_progress.Progress | None] = None  # of the outermost bar that is entered

    def __init__(self, title: str, total: int, done: int = 0, shown: bool = True) -> None:
        self._title, self._total, self._done, self._already = visible(title), total, done, done
        self._shown = shown
        self._bar: rich_progress.Progress | None = None

    def __enter__(self) -> "Progress":
        self._began = self._last_line = time.monotonic()
        if self._shown and sys.stderr.isatty():
            self._is_outermost = Progress._display is None
            self._bar = Progress._display or rich_progress.Progress(
                rich_progress.TextColumn("{task.description}", markup=False),
                rich_progress.BarColumn(),
                rich_progress.MofNCompleteColumn(),
                rich_progress.TextColumn("{task.fields[note]}", markup=False),
                rich_progress.TimeElapsedColumn(),
                rich_progress.TextColumn("left"),
                _TimeLeft(),
                console=Console(file=styled(sys.stderr)),
            )
            self._task = self._bar.add_task(
                self._title, total=self._total, completed=self._done, note="", end=None
            )
            if self._is_outermost:
                Progress._display = self._bar
                self._bar.start()
        elif self._shown and self._done < self._total:
            log.info("%s: %d of %d", self._title, self._done, self._total)
        return self

    def advance(self, note: str = "") -> None:
        """One item is done; `note` is shown beside the count."""
        self._done += 1
        now = time.monotonic()
        elapsed = now - self._began
        left = elapsed / (self._done - self._already) * (self._total - self._done)
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, note=visible(note), end=now + left)
            return
        if self._shown and (now - self._last_line >= LINE_EVERY_S or self._done == self._total):
            self._last_line = now
            log.info(
                "%s: %d of %d  %s  %.0f s, %.0f s left",
                self._title, self._done, self._total, note, elapsed, left,
            )  # fmt: skip

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is None:
            return
        if self._is_outermost:
            Progress._display = None
            self._bar.stop()
        else:
            self._bar.remove_task(self._task)


class _TimeLeft(rich_progress.ProgressColumn):
    """The time left as the items so far predict it; rich's own estimate needs many items within half a minute."""

    def render(self, task: rich_progress.Task) -> Text:
        end = task.fields["end"]
        left = "-:--:--" if end is None else str(timedelta(seconds=max(0, round(end - time.monotonic()))))
        return Text(left, style="progress.remaining")
