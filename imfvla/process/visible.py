"""Text of others for terminals and logs: what would act there, or hide, is shown as an escape. Imports nothing slow."""

import io
import logging
import unicodedata
from typing import Any, TextIO

# Control characters, invisible formatting (bidirectional overrides among them), lone surrogates of file names that
# are no UTF-8, separators of lines and paragraphs.
HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
INDENT = "    "


def visible(text: str, keep: str = "") -> str:
    """`text` with its hidden characters as in "\\x1b" or "\\u202e", those in `keep` apart; then it is one line."""
    if text.isprintable():
        return text
    return "".join(_escaped(c) if _is_hidden(c) and c not in keep else c for c in text)


def message(text: str) -> str:
    """`text` as one message: later lines are indented, so that no line break in a name begins another message."""
    return visible(text, keep="\n\t").replace("\n", f"\n{INDENT}")


class MessageFormatter(logging.Formatter):
    """Of log records, as `message`."""

    def format(self, record: logging.LogRecord) -> str:
        return message(super().format(record))


class VisibleStream(io.TextIOWrapper):
    """A text stream on which only line breaks and tabs act."""

    def write(self, text: str) -> int:
        super().write(visible(text, keep="\n\t"))
        return len(text)


class _Styled:
    """A `VisibleStream` for text that has escape sequences of our own."""

    def __init__(self, stream: VisibleStream) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return io.TextIOWrapper.write(self._stream, text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def styled(stream: TextIO) -> TextIO:
    """`stream` for bold text and bars. Text of others must have gone through `visible` before."""
    return _Styled(stream) if isinstance(stream, VisibleStream) else stream


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in HIDDEN


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
