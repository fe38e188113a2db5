"""The files of one evaluation: rows as they come, so that it can resume after a kill, and the result at the end."""

import json
import logging
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from imfvla.config.protocol import as_recorded
from imfvla.errors import UserError
from imfvla.reporting.episodes import read_row
from imfvla.reporting.rows import Row
from imfvla.storage.documents import parse_json, read_json
from imfvla.storage.files import clear_write_errors, take_lock, write_json, write_text
from imfvla.storage.fingerprint import code_version

log = logging.getLogger(__name__)

PARTIAL = "episodes.partial.jsonl"  # a header with protocol and code, then rows as they came


class RolloutLog:
    """Holds the folder of one evaluation while it runs.

    `summary` is that of a finished evaluation of the same protocol, else None; `rows` are those that an
    interrupted evaluation of the same protocol and code has left. Raises UserError where
    another process holds the folder or a file in it cannot be read or written.
    """

    def __init__(self, path: Path, protocol: Mapping[str, Any], *, overwrite: bool = False) -> None:
        self.path = path
        self._protocol = dict(protocol)
        self._overwrite = overwrite
        self._partial = path / PARTIAL

    def __enter__(self) -> "RolloutLog":
        with clear_write_errors(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.path, os.O_RDONLY)
        if not take_lock(self._lock, self.path):
            os.close(self._lock)
            raise UserError(f"{self.path} is in use by another evaluation: wait for it or stop it.")
        self._stream = None
        self.rows: list[dict[str, Any]] = []
        self.summary = None if self._overwrite else self._finished()
        if self.summary is None:
            self._open_partial()
        return self

    def append(self, row: Row) -> None:
        """Adds a row and writes it to disk at once."""
        with clear_write_errors(self._partial):
            self._stream.write(dump_row(row))
            self._stream.flush()
        self.rows.append(dict(row))

    def finish(self, rows: Iterable[Row], summary: Mapping[str, Any]) -> None:
        """Writes `episodes.jsonl` and `summary.json`, each whole or not at all, the summary last."""
        write_text(self.path / "episodes.jsonl", "".join(dump_row(row) for row in rows))
        write_json(self.path / "summary.json", summary)
        self._stream.close()
        self._stream = None
        self._partial.unlink()
        self.summary = dict(summary)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stream is not None:
            self._stream.close()
            if not self.rows:  # nothing to resume from
                self._partial.unlink()
                with suppress(OSError):  # unless it holds an earlier evaluation
                    self.path.rmdir()
        os.close(self._lock)

    def _finished(self) -> dict[str, Any] | None:
        path = self.path / "summary.json"
        if not path.exists():
            return None
        summary = read_json(path, "delete it and evaluate again", mapping=True)
        recorded = summary.get("protocol")
        if isinstance(recorded, dict) and as_recorded(recorded) == self._protocol:
            log.info("%s is finished already; overwrite=true repeats it.", self.path)
            return summary
        log.info("%s was made with another policy or protocol and is replaced.", self.path)
        return None

    def _open_partial(self) -> None:
        header = {"protocol": self._protocol, "code": code_version()}
        lines = []
        if self._partial.exists():
            lines = self._partial.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
        if lines and not lines[-1].endswith("\n"):  # cut off by a kill
            lines.pop()
        try:
            found = parse_json(lines[0]) if lines else None
            rows = [read_row(line, PARTIAL) for line in lines[1:]]
        except (ValueError, UserError):
            found, rows = "damaged", []
        if found == header:
            self.rows = rows
            log.info("%s: %d episodes exist already.", self.path, len(rows))
        elif found is not None:
            log.info("%s is damaged or of another policy, protocol or code: starting over.", self._partial)
        text = json.dumps(header) + "\n" + "".join(dump_row(row) for row in self.rows)
        write_text(self._partial, text)
        self._stream = open(self._partial, "a", encoding="utf-8")  # noqa: SIM115  closed by finish or on exit


def dump_row(row: Row) -> str:
    """One line of JSON, keys in their order."""
    return json.dumps(row) + "\n"
