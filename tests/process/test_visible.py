"""What text of others can do to a terminal and to a log: nothing."""

import io
import logging
import os
import subprocess
import sys
import unicodedata

import pytest
from rich.console import Console

from imfvla.process.progress import Progress
from imfvla.process.visible import HIDDEN, MessageFormatter, VisibleStream, message, styled, visible

# A title of the window, red, the cursor up and back, the C1 form of ESC [, a bidirectional override, a lone surrogate.
HOSTILE = "\x1b]0;owned\x07\x1b[31mred\x1b[2A\r\x9b1mC1\u202egpj.exe\u2066\udcff\x7f\x00"
SHOWN = r"\x1b]0;owned\x07\x1b[31mred\x1b[2A\r\x9b1mC1\u202egpj.exe\u2066\udcff\x7f\x00"


def test_what_acts_or_hides_is_shown():
    assert visible(HOSTILE) == SHOWN
    assert visible("a\nb\tc\u2028d") == r"a\nb\tc\u2028d"
    assert visible("a\nb\x1b", keep="\n") == "a\nb\\x1b"


@pytest.mark.parametrize(
    "text", ["plain", "1.25× [1.00×, 1.50×]", "é 你好 π₀ 🙂", "a\N{NO-BREAK SPACE}b", "C:\\new"]
)
def test_what_can_be_read_stays(text):
    assert visible(text) is text or visible(text) == text


def test_every_hidden_character_becomes_ascii():
    hidden = [chr(code) for code in range(0x11000) if unicodedata.category(chr(code)) in HIDDEN]
    assert len(hidden) > 2000
    assert all(visible(character).isascii() and visible(character).isprintable() for character in hidden)


def test_a_log_line_begins_no_other():
    record = logging.LogRecord(
        "x", 20, "f", 1, "%s is done", ("a\n2026-11-27 INFO all is well\x1b[1m",), None
    )
    text = MessageFormatter("%(levelname)s %(message)s").format(record)
    assert text == "INFO a\n    2026-11-27 INFO all is well\\x1b[1m is done"
    assert message("one") == "one"


def test_the_configs_log_through_it():
    from imfvla.command.composition import CONFIG_DIRECTORY

    for path in (CONFIG_DIRECTORY / "hydra" / "job_logging").glob("*.yaml"):
        text = path.read_text(encoding="utf-8")
        name = f"{MessageFormatter.__module__}.{MessageFormatter.__qualname__}"
        assert text.count("format:") == text.count(f"class: {name}") == 1, path


def test_a_stream_shows_what_others_wrote_and_passes_our_own_style():
    raw = io.BytesIO()
    stream = VisibleStream(raw, encoding="utf-8", errors="backslashreplace", write_through=True)
    assert stream.write(HOSTILE) == len(HOSTILE)
    stream.writelines(["\n", "a\tb\n"])
    assert raw.getvalue().decode() == SHOWN + "\na\tb\n"
    Console(file=styled(stream), force_terminal=True, color_system="standard").print("[bold]ours[/]")
    assert "\x1b[1mours\x1b[0m" in raw.getvalue().decode()
    assert styled(sys.__stderr__) is sys.__stderr__


def test_commands_write_through_it(tmp_path):
    body = (
        "from imfvla.command import as_command, begin\nbegin()\nimport sys\nfrom imfvla.errors import UserError\n"
        "@as_command\ndef main():\n    print(sys.argv[1])\n    raise UserError(sys.argv[1] + '\\nDone.')\n"
        "sys.exit(main())\n"
    )
    (tmp_path / "script.py").write_text(body)
    name = "a\x1b[31m\u202eb"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, tmp_path / "script.py", name]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, encoding="utf-8"
    )
    assert (done.returncode, done.stdout) == (2, "a\\x1b[31m\\u202eb\n")
    assert done.stderr == "a\\x1b[31m\\u202eb\\nDone.\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_bar_shows_names_as_they_are(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("[/red]\x1b]0;owned\x07", 2) as bar:  # closes a style that was never opened
        bar.advance("[link=https://example.org]\x1b[31m")
        bar._bar.refresh()
    assert "\x1b]0;" not in terminal.getvalue()
    assert "\x1b[31m" not in terminal.getvalue()
    assert r"[/red]\x1b]0;owned\x07" in terminal.getvalue()
