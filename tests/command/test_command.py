"""What surrounds every command: exit codes, sentences, stops, and streams in any state."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from imfvla.command import as_command
from imfvla.errors import UserError

SCRIPT = """
from imfvla.command import as_command, begin
begin()
import sys

@as_command
def main():
    {body}

sys.exit(main())
"""


@pytest.fixture
def run(tmp_path):
    """The finished process of a command with this body, started by a shell line in which {} is the command."""

    def run(body, line="{}", **environment):
        (tmp_path / "script.py").write_text(SCRIPT.format(body=body))
        shell = line.format(f"{sys.executable} script.py")
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment
        return subprocess.run(
            ["bash", "-c", shell], cwd=tmp_path, env=environment, capture_output=True, check=False, timeout=60
        )

    return run


def test_what_nobody_reads_is_dropped(run):
    body = "[print(n, file=f, flush=True) for n in range(2000) for f in (sys.stdout, sys.stderr)]; open('end', 'w')"
    done = run(body, "{} 2>&1 | head -1; echo ${{PIPESTATUS[0]}}; ls end")
    assert (done.stdout, done.stderr) == (b"0\n0\nend\n", b"")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_what_is_said_is_out_when_the_process_is_killed(run, unbuffered):
    body = "print('said', file=sys.stderr); import os; os.kill(os.getpid(), 9)"
    assert run(body, "{} 2>&1 | cat", PYTHONUNBUFFERED=unbuffered).stdout == b"said\n"


def test_a_result_that_cannot_be_written_is_an_error(run):
    done = run("print('result')", "{} > /dev/full")
    assert done.returncode == 2
    assert done.stderr.startswith(b"No space left on device at standard output: free some space there;")
    assert done.stderr.count(b"\n") == 1
    assert run("print('a line', file=sys.stderr)", "{} 2> /dev/full").returncode == 0


def test_streams_that_are_closed_are_no_place_for_files(run):
    done = run(
        "print('lost'); open('fileno', 'w').write(str(open('file', 'w').fileno()))",
        "{} <&- >&- 2>&-; cat fileno",
    )
    assert int(done.stdout) > 2


def test_any_character_is_printed_whatever_the_locale(run):
    done = run(r"print('83 \u00b1 4')", LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert (done.returncode, done.stdout) == (0, b"83 \\xb1 4\n")


@pytest.mark.parametrize("place", ["before", "inside"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stop_while_modules_are_imported_ends_in_one_sentence(run, tmp_path, place, number, code):
    (tmp_path / "slow.py").write_text(
        f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(60)\n"
    )
    body = "try:\n        import slow\n    except BaseException: pass"
    if place == "before":
        body = "pass\n\nimport slow"
    done = run(body)
    assert done.returncode == code
    assert done.stderr in (b"Interrupted.\n", b"Stopped by SIGTERM; rerun the same command to resume.\n")


def test_a_stop_that_a_library_turns_into_an_error_is_a_stop(capsys):
    @as_command
    def main():
        try:
            signal.raise_signal(signal.SIGTERM)
        except BaseException:
            raise ImportError("initialization failed") from None

    assert main() == 143
    assert capsys.readouterr().err == "Stopped by SIGTERM; rerun the same command to resume.\n"


def failing(error, cause=None):
    @as_command
    def main():
        raise error from cause

    return main


@pytest.mark.parametrize(
    ("error", "cause", "words"),
    [
        (UserError("a is wrong."), None, "a is wrong.\n"),
        (
            PermissionError(errno.EACCES, "Permission denied", "runs"),
            None,
            "Permission denied at runs: check who may",
        ),
        (
            ValueError("handler 'file'"),
            IsADirectoryError(errno.EISDIR, "Is a directory", "x.log"),
            "at x.log: remove",
        ),
        (
            MemoryError("unable to allocate 7 GiB"),
            None,
            "Out of memory: unable to allocate 7 GiB; choose fewer",
        ),
    ],
)
def test_what_the_user_can_correct_is_reported_in_one_sentence(capsys, error, cause, words):
    assert failing(error, cause)() == 2
    printed = capsys.readouterr().err
    assert words in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize("error", [FileNotFoundError(errno.ENOENT, "No such file", "x"), KeyError("x")])
def test_our_own_mistakes_are_raised(error):
    with pytest.raises(type(error)):
        failing(error)()


def test_the_error_of_a_write_is_reported_and_not_that_of_closing_the_file(capsys):
    @as_command
    def main():
        try:
            raise UserError("Cannot write metrics.jsonl.")
        finally:
            raise OSError(errno.ENOSPC, "No space left on device")

    assert main() == 2
    assert capsys.readouterr().err == "Cannot write metrics.jsonl.\n"


def test_a_working_directory_that_is_gone_is_reported(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert as_command(lambda: 0)() == 2
    assert capsys.readouterr().err == "The working directory is gone: change into one that exists.\n"
