"""python -m imfvla.evaluate run=DIR episodes=100 first_seed=100000 nfe=1,2,3"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

import os
import re
import sys
from collections.abc import Sequence
from typing import Any

from imfvla.entry import entry_point
from imfvla.errors import UserError
from imfvla.options import require
from imfvla.run_directory import RunDirectory


@entry_point("evaluate")
def _evaluate(config: dict[str, Any]) -> None:
    from imfvla.evaluation import evaluate  # after the config is checked: a slip is told at once
    from imfvla.reporting.table_row import print_row

    if not config["run"]:
        raise UserError("evaluate needs the directory of a training run: run=runs/<experiment>/<name>.")
    for key in ("episodes", "first_seed", "noise_seed"):
        require(_is_whole(config[key]), key, "a whole number", config[key])
    for key in ("workers", "max_steps"):
        require(config[key] is None or _is_whole(config[key]), key, "null or a whole number", config[key])
    require(_is_number(config["noise_scale"]), "noise_scale", "a number", config["noise_scale"])
    timeout_s = config["episode_timeout_s"]
    require(
        timeout_s is None or _is_number(timeout_s),
        "episode_timeout_s",
        "null or a number of seconds",
        timeout_s,
    )
    run = RunDirectory(config["run"])
    options = {key: value for key, value in config.items() if key not in ("run", "nfe")}
    summaries = evaluate(run, nfe=read_nfe(config["nfe"]), **options)
    folders = [run.rollouts(summary["name"]) for summary in summaries]
    print_row(run, only=[folder.name for folder in folders])
    for folder in folders:
        print(folder)


def main(argv: Sequence[str] | None = None) -> None:
    """The command. Takes `nfe=1,2,3` as a list, where Hydra would take it for a sweep, and a directory as it is."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not {"-m", "--multirun"} & set(arguments):
        arguments = nfe_as_list(arguments)
    _evaluate([_with_directory_quoted(text) for text in arguments])


def _with_directory_quoted(argument: str) -> str:
    """`run=DIR` for Hydra, where DIR is there: names of runs have `=` and `,` in them."""
    directory = argument.removeprefix("run=")
    is_directory = directory != argument and os.path.isdir(directory)
    return f"run={quoted(directory)}" if is_directory else argument


def quoted(text: str) -> str:
    """`text` as Hydra writes a value that is to be taken as it is."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def nfe_as_list(arguments: Sequence[str]) -> list[str]:
    """The arguments with `nfe=1,2,3` written as Hydra writes a list."""
    return [re.sub(r"^nfe=(\d+(?:,\d+)+)$", r"nfe=[\1]", text) for text in arguments]


def read_nfe(value: Any) -> list[int]:
    """Numbers of flow evaluations from a number, a list, or a text such as "1,2,3". Raises UserError."""
    items = value.split(",") if isinstance(value, str) else value if isinstance(value, list) else [value]
    try:
        numbers = [item if _is_whole(item) else int(str(item)) for item in items]
    except ValueError:
        numbers = []
    require(
        bool(numbers) and min(numbers) >= 1,
        "nfe",
        "one or more whole numbers of at least 1, such as 1,2,3",
        value,
    )
    return numbers


def _is_number(value: Any) -> bool:
    return _is_whole(value) or isinstance(value, float)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


if __name__ == "__main__":
    main()
