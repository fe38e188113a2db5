"""The files of one evaluation: rows as they come, so that it can resume after a kill, and the result at the end."""

import json
import logging
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from imfvla.errors import UserError
from imfvla.reporting.episodes import check_goals, read_row
from imfvla.reporting.recomputed import DESCRIPTION, EPISODES, description_digest, digest_of, recomputed
from imfvla.reporting.recomputed import DIGEST as EPISODES_DIGEST
from imfvla.reporting.records import Row
from imfvla.reporting.runs import read_summary
from imfvla.storage.appended import AppendedFile
from imfvla.storage.documents import parse_json, read_text, refuse_many_parts
from imfvla.storage.files import (
    clear_write_errors,
    delete_leftovers,
    make_folder,
    sync,
    take_lock,
    write_json,
    write_text,
)
from imfvla.storage.fingerprint import code_version
from imfvla.storage.opening import ROWS
from imfvla.storage.trained_config import DIGEST

log = logging.getLogger(__name__)

PARTIAL = "episodes.partial.jsonl"  # a header with protocol and code, then rows as they came


class RolloutLog:
    """Holds the folder of one evaluation while it runs.

    `summary` is that of a finished evaluation of the same protocol, else None; `rows` are those that an
    interrupted evaluation of the same protocol, config, code and conditions has left: see `begin`. Raises UserError
    where another process holds the folder or a file in it cannot be read or written, and where a finished evaluation
    lacks its episodes.
    """

    def __init__(
        self, path: Path, protocol: Mapping[str, Any], *, config_digest: str = "", overwrite: bool = False
    ) -> None:
        self.path = path
        self._protocol, self._config_digest = dict(protocol), config_digest
        self._overwrite = overwrite
        self._partial = path / PARTIAL

    def __enter__(self) -> "RolloutLog":
        with clear_write_errors(self.path):
            make_folder(self.path)
            self._lock = os.open(self.path, os.O_RDONLY)
        if not take_lock(self._lock, self.path):
            os.close(self._lock)
            raise UserError(f"{self.path} is in use by another evaluation: wait for it or stop it.")
        for name in (PARTIAL, "episodes.jsonl", "summary.json"):
            delete_leftovers(self.path / name)
        self._stream = None
        self.rows: list[dict[str, Any]] = []
        try:
            self.summary = None if self._overwrite else self._finished()
        except BaseException:
            os.close(self._lock)
            raise
        return self

    def begin(self, **conditions: Any) -> None:
        """Takes over the rows that were left, before the first `append`.

        `conditions` are what rows depend on beside protocol, config and code, such as `gl_renderer`.
        """
        self._open_partial(
            {"protocol": self._protocol, DIGEST: self._config_digest, "code": code_version(), **conditions}
        )

    def append(self, row: Row) -> None:
        """Adds a row and forces it to disk at once."""
        self._stream.write(dump_row(row).encode("utf-8"))
        self._stream.sync()
        self.rows.append(dict(row))

    def finish(self, rows: Iterable[Row], summary: Mapping[str, Any]) -> None:
        """Writes `episodes.jsonl` and `summary.json`, each whole or not at all, the summary last."""
        summary_path = self.path / "summary.json"
        with clear_write_errors(self.path):
            # Of other rows: a kill must not leave it beside the new ones.
            summary_path.unlink(missing_ok=True)
            sync(self.path)
        text = "".join(dump_row(row) for row in rows)
        write_text(self.path / EPISODES, text)
        summary = {**summary, DIGEST: self._config_digest, EPISODES_DIGEST: digest_of(text)}
        summary[DESCRIPTION] = description_digest(summary)
        write_json(summary_path, summary)
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
        with suppress(OSError):  # unless it holds rows or an evaluation
            self.path.rmdir()
        os.close(self._lock)

    def _finished(self) -> dict[str, Any] | None:
        path = self.path / "summary.json"
        if not path.exists():
            return None
        summary = read_summary(path)
        if summary["protocol"] == self._protocol:
            summary, _ = recomputed(self.path, summary)
            log.info("%s is finished already; overwrite=true repeats it.", self.path)
            return summary
        log.info("%s was made with another policy or protocol and is replaced.", self.path)
        return None

    def _open_partial(self, header: Mapping[str, Any]) -> None:
        lines = []
        if self._partial.exists():
            lines = self._left()
        if lines and not lines[-1].endswith("\n"):  # cut off by a kill
            lines.pop()
        try:
            found = parse_json(lines[0]) if lines else None
            rows = [read_row(line, PARTIAL) for line in lines[1:]]
            check_goals(rows, PARTIAL)
        except (ValueError, UserError):
            found, rows = "damaged", []
        if found == header:
            self.rows = rows
            log.info("%s: %d episodes exist already.", self.path, len(rows))
        elif found is not None:
            keys = header if not isinstance(found, dict) else [k for k in header if found.get(k) != header[k]]
            log.warning("%s is damaged or of another %s: starting over.", self._partial, ", ".join(keys))
        text = json.dumps(header) + "\n" + "".join(dump_row(row) for row in self.rows)
        write_text(self._partial, text)
        self._stream = AppendedFile(self._partial)

    def _left(self) -> list[str]:
        """The lines of an interrupted evaluation."""
        try:
            text = read_text(self._partial, ROWS)
            refuse_many_parts(text)
        except UserError:  # a pipe or a link, which is not ours to replace
            raise
        except ValueError:
            return ["damaged\n"]
        return text.splitlines(keepends=True)


def dump_row(row: Row) -> str:
    """One line of JSON, keys in their order."""
    return json.dumps(row) + "\n"
