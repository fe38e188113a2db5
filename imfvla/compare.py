"""python -m imfvla.compare RUN_A RUN_B [nfe=2]: two runs compared per start state: a verdict, a table and a picture."""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imfvla.command.entry import entry_point
from imfvla.command.line import quoted
from imfvla.errors import UserError
from imfvla.evaluate import read_nfe
from imfvla.options import build
from imfvla.storage.run_directory import RunDirectory


@dataclass(frozen=True, slots=True)
class CompareOptions:
    """conf/compare.yaml."""

    runs: tuple[str, ...]
    nfe: Any  # see `read_nfe`
    output: str


@entry_point("compare")
def _compare(config: dict[str, Any]) -> None:
    build(CompareOptions, config, "")
    if len(config["runs"]) != 2:
        raise UserError(
            f"compare needs two run directories, found {len(config['runs'])}: python -m imfvla.compare RUN_A RUN_B."
        )
    nfe = None if config["nfe"] is None else read_nfe(config["nfe"])
    if nfe is not None and len(nfe) > 2:
        raise UserError(f"nfe must be one number, or one for each run, found {nfe}.")
    runs = [RunDirectory(path) for path in config["runs"]]
    for run in runs:
        run.config()
    # Imported late, so that a mistake in the command is reported at once.
    from imfvla.figures.style import render
    from imfvla.figures.two_runs import two_runs
    from imfvla.reporting.two_runs import compare_runs, table_of, verdict
    from imfvla.storage.files import write_together

    duels = compare_runs(*runs, nfe)
    table, verdicts = table_of(duels), [verdict(duel) for duel in duels]
    text = "\n\n".join(verdicts)
    output = Path(config["output"])
    files = {output / "comparison.md": f"{text}\n\n{table.markdown()}".encode()}
    files[output / "comparison.csv"] = table.csv().encode()
    files |= {output / f"comparison{suffix}": content for suffix, content in render(two_runs(duels)).items()}
    write_together(files)
    table.print()
    print(f"{text}\n")
    for path in files:
        print(path)


def main(argv: Sequence[str] | None = None) -> None:
    """The command. Takes directories as they are: `RUN_A RUN_B` for `runs=[RUN_A,RUN_B]`."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    named = [text for text in arguments if os.path.exists(text) or not ("=" in text or text.startswith("-"))]
    others = [text for text in arguments if text not in named]
    _compare([*others, f"runs=[{','.join(map(quoted, named))}]"] if named else others)


if __name__ == "__main__":
    main()
