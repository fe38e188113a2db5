"""python -m imfvla.report [run=DIR]"""

from pathlib import Path
from typing import Any

from imfvla.entry import entry_point
from imfvla.errors import UserError
from imfvla.reporting.runs import find_runs
from imfvla.reporting.table_row import print_row
from imfvla.reporting.tables import collect, tables, write
from imfvla.run_directory import RunDirectory


@entry_point("report")
def main(config: dict[str, Any]) -> None:
    """Prints the rows of one run, or the tables of all runs, which it also writes as Markdown and CSV."""
    if config["run"]:
        print_row(RunDirectory(config["run"]))
        return
    directories = [Path(directory) for directory in config["directories"]]
    runs = find_runs(directories)
    if not runs:
        raise UserError(
            f"No run with a finished evaluation below {', '.join(map(str, directories))}: make one with "
            "python -m imfvla.train +exp=socket_ph32_exec16, or name directories=[...]."
        )
    named = tables(collect(runs))
    paths = write(named, Path(config["output"]))
    for table in named.values():
        table.print()
    for path in paths:
        print(path)


if __name__ == "__main__":
    main()
