"""A run directory from outside: a link out of it, something that blocks, or a file without end in a file's place."""

import os
import random
import signal
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from synthetic_runs import make_run, write_evaluation
from tiny_policy import TinyPolicy

from faults.killing import POLL_S, ended_or_late, last_words, start
from faults.outcome import Differs
from faults.work import OF_FAKES, play, train
from imfvla.reporting.media import Media
from imfvla.reporting.runs import evaluations
from imfvla.storage.files import write_together
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_weights, save_weights
from imfvla.training.logger import read_metrics

MAX_S = 120.0  # of one command, which takes a second on a machine with nothing else to do
SECRET = b'{"of": "nobody else"}\n'
HUGE = 8 * 10**9  # bytes, of zeros that take no space
NAMES = (
    "config.yaml",
    "status.json",
    "metrics.jsonl",
    "train.log",
    "made_by.json",
    ".lock",
    "checkpoints",
    "checkpoints/last",
    "checkpoints/last/state.safetensors",
    "checkpoints/step-1/policy.safetensors",
    "checkpoints/step-1/policy.json",
    "rollouts",
    "rollouts/{evaluation}",
    "rollouts/{evaluation}/summary.json",
    "rollouts/{evaluation}/episodes.jsonl",
    "rollouts/{evaluation}/best.mcap",
    "rollouts/{evaluation}/best.mp4",
    "tensorboard",
)


def publish(output: Path, run: Path) -> None:
    """Copies all files of a run, as a page does that can be moved."""
    media = Media(output, is_copied=True)
    files = [
        path for path in sorted(run.rglob("*")) if path.suffix in (".mcap", ".mp4", ".log", ".json", ".jsonl")
    ]
    links = [media.link(path, run) for path in files]
    write_together({output / "index.html": "\n".join(filter(None, links)).encode()}, media.copies)


def read(run: Path) -> None:
    """What a report reads of a run."""
    directory = RunDirectory(run)
    directory.config(), directory.status(), read_metrics(directory.metrics), evaluations(directory)
    load_weights(TinyPolicy(), directory.policy_weights(1), home=run)


def resume(run: Path) -> None:
    """What a training does in its directory before and after its first step."""
    directory = RunDirectory(run)
    directory.refuse_strangers()
    with directory.lock():
        directory.write_status("running")
        train(run, steps=2)


def evaluate(run: Path) -> None:
    """What an evaluation does, which checks the size of the weights first, as the command does."""
    load_weights(TinyPolicy(), RunDirectory(run).policy_weights(1), home=run)
    play(run, episodes=2)


def link(path: Path, secret: Path) -> None:
    path.symlink_to(secret)


def pipe(path: Path, secret: Path) -> None:
    os.mkfifo(path)


def listen(path: Path, secret: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        os.chdir(path.parent)  # the name of a socket may have 100 letters
        server.bind(path.name)


def device(path: Path, secret: Path) -> None:
    os.mknod(path, 0o20666, os.makedev(1, 5))  # zeros without end


def folder_in_place(path: Path, secret: Path) -> None:
    path.mkdir()


def huge(path: Path, secret: Path) -> None:
    with open(path, "wb") as stream:
        stream.truncate(HUGE)


KINDS = (link, pipe, listen, device, folder_in_place, huge)


def strangers(folder: Path, kills: int, rng: random.Random) -> str:
    """Commands end in time with a clear error or without one; what lies outside is neither read nor written."""
    secret, refused = folder / "secret", 0
    secret.write_bytes(SECRET)
    tries = 4 * kills
    for number in range(tries):
        place = folder / str(number)
        run = make_run(place / "run", "socket_ph32_exec16", **OF_FAKES)
        evaluation = write_evaluation(run, 1, number=3)
        save_weights(RunDirectory(run).weights_directory(1), TinyPolicy(), {})
        for name in ("best.mcap", "best.mp4"):
            (evaluation / name).write_bytes(b"a recording")
        name, kind = rng.choice(NAMES).format(evaluation=evaluation.name), rng.choice(KINDS)
        path = run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path):
            path.rename(place / "moved away")
        here = os.getcwd()
        kind(path, secret)
        os.chdir(here)
        work = rng.choice((partial(publish, place / "page"), read, resume, evaluate))
        what = f"{kind.__name__} at {name}"
        code = outcome(lambda _, work=work, run=run: work(run), place / "work", what)
        if code not in (0, 2):
            raise Differs(f"{what}: exit code {code}: {last_words(place / 'work')}")
        refused += code == 2
        if secret.read_bytes() != SECRET or sorted(p.name for p in folder.iterdir()) != names_of(
            folder, number
        ):
            raise Differs(f"{what}: something outside was written")
        if any(SECRET in found.read_bytes() for found in (place / "page").rglob("*") if found.is_file()):
            raise Differs(f"{what}: a file from outside was published")
    return f"{tries} strangers, {refused} refused, none followed or waited for"


def names_of(folder: Path, number: int) -> list[str]:
    return sorted(["secret", *map(str, range(number + 1))])


def outcome(work: Callable[[Path], None], folder: Path, what: str) -> int:
    """The exit code of work, which must end in time."""
    child, deadline = start(work, folder), time.monotonic() + MAX_S
    while ended_or_late(child, deadline):
        time.sleep(POLL_S)
    if time.monotonic() >= deadline:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise Differs(f"{what}: no end after {MAX_S} s: {last_words(folder)}")
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
