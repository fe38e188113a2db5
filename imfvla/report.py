"""python -m imfvla.report [run=DIR]"""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra

from imfvla.composition import compose
from imfvla.entry import entry_point
from imfvla.options import require
from imfvla.run_directory import RunDirectory


@entry_point("report")
def main(config: dict[str, Any]) -> None:
    """Prints the rows of one run, or publishes the tables of all runs: Markdown, CSV, LaTeX, figures and a page."""
    if config["run"]:
        from imfvla.reporting.table_row import print_row

        print_row(RunDirectory(config["run"]))
        return
    from imfvla.publication import publish  # after the config is checked: a slip is told at once
    from imfvla.reporting.mapping import PATH, read_mapping

    mapping = read_mapping(Path(config["mapping"]) if config["mapping"] else PATH)
    directories = [Path(directory) for directory in config["directories"]]
    GlobalHydra.instance().clear()  # the method is composed below
    method = compose("train", config["method"])
    require(isinstance(config["media"], bool), "media", "true or false", config["media"])
    publication = publish(directories, Path(config["output"]), mapping, method, media=config["media"])
    paths = publication.write()
    for table in publication.tables:
        table.print()
    for path in paths:
        print(path)


if __name__ == "__main__":
    main()
