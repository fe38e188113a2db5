"""SIGKILL while a folder is made that must be whole or absent, and several processes that make one at once."""

import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from synthetic import write_demonstrations

from faults.killing import Work, last_words, start, undisturbed
from faults.outcome import Differs
from faults.space import files_in, names_in
from imfvla.deployment.exporting import write_folder
from imfvla.sources.conversion import convert

MADE = "made"
AT_ONCE = 4
LEFT = {f".{MADE}.part", f".{MADE}.lock"}  # what one killed process may leave


def folders(folder: Path, kills: int, rng: random.Random) -> str:
    """Conversions and exports, `kills` times each: what is there after a kill is what an undisturbed one makes."""
    demos = write_demonstrations(folder / "demos", num_episodes=3, num_steps=8)
    works: dict[str, tuple[Work, Callable[[Path], dict[str, Any]]]] = {
        "mcap": (partial(to_format, "mcap", demos), files_in),
        "lerobot": (partial(to_format, "lerobot", demos), names_in),
        "export": (export, files_in),
    }
    left = 0
    for name, (work, leaves) in works.items():
        whole, place = folder / "whole" / name, folder / "killed" / name
        whole.parent.mkdir(exist_ok=True)
        place.mkdir(parents=True)
        began = time.monotonic()
        undisturbed(work, whole)
        needed_s = time.monotonic() - began
        for _ in range(kills):
            child = start(work, place)
            time.sleep(rng.random() * needed_s)
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            left += _check(place, leaves(whole / MADE), leaves, name)
        _make_at_once(work, place, name)
        _check(place, leaves(whole / MADE), leaves, name)
        if names := set(os.listdir(place)) - {MADE}:
            raise Differs(f"{name}: left behind: {names}")
    return (
        f"{kills * len(works)} kills over conversions and exports, {left} of them left something, which the next one "
        f"deleted; {AT_ONCE} at once made one folder each time"
    )


def to_format(target: str, demos: Path, folder: Path) -> None:
    """All demonstrations in another format."""
    options = {"format": target, "path": str(folder / MADE)}
    pictures = {"pictures": "h264"} if target == "lerobot" else {}
    convert({"source": "mcap", "path": str(demos)}, options | pictures)


def export(folder: Path) -> None:
    """As many files as an export with three numbers of evaluations has."""
    graphs = {f"infer{nfe}.onnx": bytes([nfe]) * 2**20 for nfe in range(1, 4)}
    write_folder(folder / MADE, graphs, {f"infer{nfe}.json": {"nfe": nfe} for nfe in range(1, 4)})


def _check(place: Path, whole: dict[str, Any], leaves: Callable[[Path], dict[str, Any]], name: str) -> bool:
    """Whether something was left beside a folder that is whole or absent, which is then taken away."""
    if (place / MADE).exists():
        if leaves(place / MADE) != whole:
            raise Differs(f"{name}: a folder that is not whole")
        shutil.rmtree(place / MADE)
    names = set(os.listdir(place))
    if names - LEFT:
        raise Differs(f"{name}: {names - LEFT} were left")
    return bool(names)


def _make_at_once(work: Work, place: Path, name: str) -> None:
    """One of several processes makes the folder, the others say that it exists."""
    children = [start(work, place) for _ in range(AT_ONCE)]
    codes = sorted(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children)
    if codes != [0] + [2] * (AT_ONCE - 1):
        raise Differs(f"{name}: exit codes {codes} of {AT_ONCE} at once: {last_words(place)}")
    if "exists already" not in last_words(place):
        raise Differs(f"{name}: {last_words(place)}")
